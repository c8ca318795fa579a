"""Codes of other people through the job that measures shape: close to the truth, or refused by name."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from support.measured_plate import in_sigmas, reconstructed, simulated

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.records.measurement import ArrayStack, FringeSequence
from sms_jobs.records.reasons import Reason

BOTH = (0.0, pi / 2)
MICRO = FringeSequence.with_counts(
    (15.0, 14.0, 14.3, 14.6, 14.8, 15.3, 15.5, 15.8, 16.0, 16.3), (3,) + (1,) * 9, BOTH
)
EMBEDDED = FringeSequence.with_counts((16, 17, 20), (3, 2, 2), BOTH)
HETERODYNE = FringeSequence((20.5, 17.3, 15.1), 4, BOTH)


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
    calibration, measurement, shape = simulated(sequence, projector={"gamma": 1.1})
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
    with pytest.raises(MeasurementFailed, match="18 fringes are stated, but the phases are those of 17"):
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
