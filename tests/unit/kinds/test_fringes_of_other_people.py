"""Codes of other people through the job that measures shape: close to the truth, or refused by name."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.in_memory import run_kind
from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape

SUBJECT = Subject("plate", "S00", "C1P1")
BOTH = (0.0, pi / 2)
MICRO = FringeSequence.with_counts(
    (15.0, 14.0, 14.3, 14.6, 14.8, 15.3, 15.5, 15.8, 16.0, 16.3), (3,) + (1,) * 9, BOTH
)
EMBEDDED = FringeSequence.with_counts((16, 17, 20), (3, 2, 2), BOTH)
HETERODYNE = FringeSequence((20.5, 17.3, 15.1), 4, BOTH)


def simulated(sequence: FringeSequence, gamma: float = 1.0) -> tuple[Calibration, Measurement, Shape]:
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(campaign.scene, projector=replace(campaign.scene.projector, gamma=gamma))
    simulation = Simulation(scene, "C1", "P1", (), state="S00")
    seen = render(simulation, sequence)
    frames = ArrayStack(seen.frames.rows(0, seen.frames.shape[1]))
    measurement = Measurement(
        calibration.valid_from, sequence, seen.full_scale, seen.gain, seen.read_noise, seen.texture, frames
    )
    return calibration, measurement, exact_shape(simulation)


def reconstructed(calibration: Calibration, measurement: Measurement, **parameters: object) -> Surface:
    records = {"measurement": measurement, "calibration": calibration}
    given = ReconstructParameters.model_validate(parameters)
    surface = run_kind(KIND, SUBJECT, records, 1, given).records["surface"]
    assert isinstance(surface, Surface)
    return surface


def in_sigmas(surface: Surface, shape: Shape) -> NDArray[np.float64]:
    """Return the errors in Z of valid pixels, 3 px inside what is lit, in their standard deviations."""
    inside = (surface.reason == Reason.VALID) & ndimage.binary_erosion(shape.lit, iterations=3)
    error = (surface.position[2] - shape.xyz[2]) / np.sqrt(surface.covariance[5])
    return np.asarray(error[inside])


@pytest.mark.parametrize(
    ("sequence", "valid"), [(MICRO, 0.8), (EMBEDDED, 0.95), (HETERODYNE, 0.93)], ids=["micro", "eps", "het"]
)
def test_shape_is_as_near_to_the_truth_as_is_stated(sequence: FringeSequence, valid: float) -> None:
    calibration, measurement, shape = simulated(sequence)
    surface = reconstructed(calibration, measurement)
    # Micro phase shifting has lines along which its single frames cannot tell the order: they are ambiguous.
    assert (surface.reason == Reason.VALID)[shape.lit].mean() > valid
    z = in_sigmas(surface, shape)
    # Errors of the texture are alike in neighbours: 9,000 pixels count as a thousand, good to 2 %.
    assert np.std(z) == pytest.approx(1.0, abs=0.1)
    # A wrong fringe order is off by some 300 deviations. One in 10,000 pixels may have one.
    assert np.count_nonzero(np.abs(z) > 10.0) <= 1


@pytest.mark.parametrize(("sequence", "most"), [(EMBEDDED, 1.1), (MICRO, 1.3)], ids=["eps", "micro"])
def test_a_projector_that_is_not_linear_makes_sigma_larger(sequence: FringeSequence, most: float) -> None:
    calibration, measurement, shape = simulated(sequence, gamma=1.1)
    z = in_sigmas(reconstructed(calibration, measurement), shape)
    # 1.3 is what broken models may have at the most; micro phase shifting has 1.19 (ADR 74).
    assert np.std(z) < most
    assert np.count_nonzero(np.abs(z) > 10.0) == 0


def test_frames_that_have_changed_places_are_named() -> None:
    calibration, measurement, _ = simulated(MICRO)
    frames = measurement.frames.rows(0, 128).copy()
    frames[[5, 9]] = frames[[9, 5]]
    with pytest.raises(
        MeasurementFailed, match=r"frames 5 \(14.6 fringes .*\) and 9 \(15.8 fringes .* changed places"
    ):
        reconstructed(calibration, replace(measurement, frames=ArrayStack(frames)))


def test_a_wrong_number_of_fringes_is_named() -> None:
    calibration, measurement, _ = simulated(EMBEDDED)
    told = FringeSequence.with_counts((16, 18, 20), (3, 2, 2), BOTH)
    with pytest.raises(MeasurementFailed, match="where 18 fringes are told, the phases are those of 17"):
        reconstructed(calibration, replace(measurement, sequence=told))


def test_the_other_direction_is_named() -> None:
    calibration, measurement, _ = simulated(EMBEDDED)
    sequence = measurement.sequence
    back = tuple(tuple(-k % sequence.steps for k in steps) for steps in sequence.shown)
    with pytest.raises(MeasurementFailed, match="seem to run along 180 and 270 deg, not along 0 and 90"):
        reconstructed(calibration, replace(measurement, sequence=replace(sequence, shown=back)))


@pytest.mark.parametrize("parameters", [{"method": "fdr"}, {"response": "measured"}])
def test_what_needs_all_steps_is_refused(parameters: dict[str, str]) -> None:
    calibration, measurement, _ = simulated(EMBEDDED)
    with pytest.raises(InvalidInput, match="have one modulation for all densities"):
        reconstructed(calibration, measurement, **parameters)
