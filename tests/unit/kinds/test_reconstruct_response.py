"""The projector's response taken out by reconstruct: shape of a plate against its exact truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.bench.fringes.bent_waveforms import record, scores
from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.kind import DatasetOutput
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import ProjectorResponse, Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import START, small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape

SUBJECT = Subject("plate", "S00", "C1P1")
UNWRAPPED = (32, 31, 30, 28, 24, 16)
RANGED = tuple(range(32))


@dataclass(frozen=True)
class Rippled:
    """A plate lit by a projector that is not linear, what is true of it, and its inside: far from edges."""

    calibration: Calibration
    measurement: Measurement
    shape: Shape
    inside: NDArray[np.bool_]

    def reconstruct(self, **parameters: object) -> DatasetOutput:
        records = {"measurement": self.measurement, "calibration": self.calibration}
        wanted = ReconstructParameters(blur_px=0.0, **parameters)  # type: ignore[arg-type]
        return run_kind(KIND, SUBJECT, records, 1, wanted)

    def judged(self, cloud: Surface) -> tuple[float, float, float]:
        """Return how much of the inside is valid, its rms error in mm, and the rms of that over sigma."""
        valid = (cloud.reason == Reason.VALID) & self.inside
        error = np.linalg.norm(cloud.position - self.shape.xyz, axis=0)[valid]
        sigma = np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0))[valid]
        rms, score = (float(np.sqrt(np.mean(np.square(v)))) for v in (error, error / sigma))
        return float(valid.sum() / self.inside.sum()), rms, score


@cache
def rippled(gamma: float, densities: tuple[int, ...], steps: int) -> Rippled:
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(campaign.scene, speckle=None, projector=ProjectorResponse(gamma))
    simulation = Simulation(scene, "C1", "P1", ())
    sequence = FringeSequence(densities, steps)
    seen = render(simulation, sequence)
    frames = ArrayStack(seen.frames.rows(0, seen.frames.shape[1]))
    measurement = Measurement(
        START, sequence, seen.full_scale, seen.gain, seen.read_noise, seen.texture, frames, simulation
    )
    shape = exact_shape(simulation)
    inside = ndimage.binary_erosion(shape.seen & shape.lit, iterations=4)
    return Rippled(calibration, measurement, shape, inside)


ROUGH = {"maximum_phase_error_rad": 0.5, "calibration_sigma_px": 1.25}


@pytest.mark.parametrize(("densities", "method"), [(UNWRAPPED, "temporal-unwrapping"), (RANGED, "fdr")])
@pytest.mark.parametrize(("steps", "gain"), [(3, 4.0), (4, 1.08)])
def test_the_ripple_is_gone_and_the_stated_error_is_true(
    densities: tuple[int, ...], method: str, steps: int, gain: float
) -> None:
    scene = rippled(1.3, densities, steps)
    before = scene.reconstruct(method=method, **ROUGH)
    after = scene.reconstruct(method=method, response="measured")
    _, was, missed = scene.judged(before.records["surface"])
    kept, error, score = scene.judged(after.records["surface"])
    # All tests of each pixel hold as they do for a linear projector: 0.2 % fail by noise.
    assert kept > 0.995
    # 9700 pixels give the rms to 0.7 %; four times that, and what a pixel's blur does to ranging.
    assert score == pytest.approx(1.0, abs=0.04)
    assert was > gain * error
    # Half of what is left follows no noise, and the ripple is one of few pixels: to a tenth.
    assert missed == pytest.approx(1.0, abs=0.1)
    # Noise of 1e-3 in each orientation.
    assert after.statistics["gamma"] == pytest.approx(1.3, abs=5e-3)
    assert after.statistics["second_harmonic"] == pytest.approx(0.3 / 3.3, abs=2e-3)  # (g - 1) / (g + 2)
    assert after.statistics["corrected_ripple_rms_rad"] > 0.0
    assert "gamma" not in before.statistics


def test_three_steps_and_a_gamma_fail_every_test_until_corrected() -> None:
    scene = rippled(1.3, UNWRAPPED, 3)
    cloud: Surface = scene.reconstruct().records["surface"]
    # A ripple of 0.06 rad where 0.02 are accepted: refused, and said why, rather than wrong.
    assert (cloud.reason[scene.inside] & Reason.HIGH_PHASE_ERROR != 0).mean() > 0.9


def test_a_linear_projector_is_left_alone() -> None:
    scene = rippled(1.0, UNWRAPPED, 4)
    clouds = [scene.reconstruct(response=r).records["surface"] for r in ("none", "measured")]
    moved = np.linalg.norm(clouds[1].position - clouds[0].position, axis=0)[scene.inside]
    # The harmonics that noise feigns, below 1e-4 of the fringe: a fiftieth of the 9 um of noise.
    assert np.sqrt(np.nanmean(moved**2)) < 2e-4


@pytest.mark.parametrize("steps", [3, 4])
def test_several_returns_of_a_projector_that_is_not_linear_are_as_good_as_stated(
    rng: np.random.Generator, steps: int
) -> None:
    seen = record(rng, FringeSequence(tuple(range(32)), steps), 1.8, 0.002, twice=True)
    found, valid = scores(seen, {"blur_px": 0.0, "method": "fdr", "returns": 2, "response": "measured"})
    # 25,000 points give the rms to 0.5 %; four times that, and of normal noise none is beyond six deviations
    # of the length of three components.
    assert valid > 0.99
    assert np.sqrt(np.mean(found**2)) == pytest.approx(1.0, abs=0.03)
    assert found.max() < 7.0


def test_what_is_left_of_the_harmonics_of_several_returns_is_stated(rng: np.random.Generator) -> None:
    seen = record(rng, FringeSequence(tuple(range(64))), 2.2, 0.001, twice=True)
    found, valid = scores(seen, {"blur_px": 0.0, "method": "fdr", "returns": 2})
    assert valid > 0.99
    assert np.sqrt(np.mean(found**2)) < 1.1
    assert found.max() < 10.0


def test_what_cannot_be_corrected_is_refused() -> None:
    scene = rippled(1.0, UNWRAPPED, 4)
    dark = ArrayStack(np.full(scene.measurement.frames.shape, 40, np.uint16))
    unlit = replace(scene, measurement=replace(scene.measurement, frames=dark))
    with pytest.raises(MeasurementFailed, match="set response=none"):
        unlit.reconstruct(response="measured")
