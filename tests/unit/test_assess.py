"""The assess kind: no error for the truth itself, the right one for known errors, nothing trimmed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import DatasetOutput, Inputs, default_subjects
from sms_jobs.kinds.reporting.assess import KIND, AssessParameters
from sms_jobs.records.assessment import Assessment
from sms_jobs.records.fields import DisplacementField, StrainField, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, Truth, exact_shape, exact_truth

CAMPAIGN = small_plate("plate")[1]
REFERENCE, DEFORMED = Subject("plate", "S00", "C1P1"), Subject("plate", "S01", "C1P1")
SIGMA_MM, SIGMA_STRAIN = 0.02, 1e-4


@dataclass(frozen=True)
class Held:
    """A dataset in memory."""

    subject: Subject
    records: dict[str, Any]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.records)

    def read(self, name: str, record: type[Any]) -> Any:
        found = self.records[name]
        assert isinstance(found, record)
        return found


@cache
def measurement(label: str) -> Measurement:
    assert CAMPAIGN.scene is not None
    state = CAMPAIGN.state(label)
    simulation = Simulation(CAMPAIGN.scene, "C1", "P1", state.deformation, label)
    r = render(simulation, CAMPAIGN.sequence)
    assert state.time is not None
    return Measurement(
        state.time, CAMPAIGN.sequence, r.full_scale, r.gain, r.read_noise, r.texture, r.frames, simulation
    )


@cache
def shape(label: str) -> Shape:
    simulation = measurement(label).simulation
    assert simulation is not None
    return exact_shape(simulation)


@cache
def truth() -> Truth:
    before, after = (measurement(label).simulation for label in ("S00", "S01"))
    assert before is not None
    assert after is not None
    return exact_truth(before, after)


def covariance(rows: int, columns: int) -> np.ndarray:
    packed = np.zeros((6, rows, columns), np.float32)
    packed[[0, 3, 5]] = SIGMA_MM**2
    return packed


def cloud(label: str, error: np.ndarray | float = 0.0) -> Surface:
    exact = shape(label)
    rows, columns = exact.seen.shape
    reason = np.where(exact.seen, Reason.VALID, Reason.LOW_MODULATION).astype(np.uint32)
    gap = np.zeros((rows, columns), np.float32)
    return Surface("C1P1", "mm", exact.xyz + error, reason, covariance(rows, columns), gap)


def displacement(error: np.ndarray | float = 0.0) -> DisplacementField:
    base = cloud("S00")
    moved = truth().displacement + error
    return DisplacementField("C1P1", "S00", "mm", moved, base.covariance, moved[:2], base.reason)


def strain(error: np.ndarray | float = 0.0, measure: Any = "green-lagrange") -> StrainField:
    base = cloud("S00")
    found = truth().strain(measure) + error
    sigma = np.full(found.shape, SIGMA_STRAIN, np.float32)
    return StrainField(measure, "mm", 10.0, found, sigma, found[:2], found[0], base.reason)


def assessed(subject: Subject, **records: Any) -> tuple[Assessment, dict[str, float]]:
    names = {"shape": "surface", "displacement": "displacement", "strain": "strain"}
    datasets = {role: Held(subject, {names[role]: record}) for role, record in records.items()}
    datasets["measurement"] = Held(subject, {"measurement": measurement(subject.state or "")})
    if subject != REFERENCE:
        datasets["reference"] = Held(REFERENCE, {"measurement": measurement("S00")})
    assert set(datasets) == {need.role for need in KIND.needs(CAMPAIGN, subject, KIND.parameters())}
    (output,) = KIND.run(
        Inputs(subject, None, datasets), AssessParameters(), lambda fraction, message="": None
    )
    assert isinstance(output, DatasetOutput)
    assert output.subject == subject
    found = output.records["assessment"]
    assert isinstance(found, Assessment)
    return found, dict(output.statistics)


def test_the_truth_has_no_error() -> None:
    found, statistics = assessed(DEFORMED, shape=cloud("S01"), displacement=displacement(), strain=strain())
    assert found.displacement is not None
    assert found.strain is not None
    for errors in (found.shape, found.displacement, found.strain):
        assert errors.rms == errors.bias == errors.largest == errors.score_rms == 0.0
        assert errors.valid_fraction == 1.0
        assert errors.false_valid_count == 0
    assert found.shape.count == shape("S01").seen.sum()
    assert statistics["displacement_rms_mm"] == 0.0
    assert statistics["strain_rms"] == 0.0


def test_a_reference_state_has_a_shape_only() -> None:
    found, statistics = assessed(REFERENCE, shape=cloud("S00"))
    assert found.displacement is None
    assert found.strain is None
    assert found.strain_error is None
    assert set(statistics) == {
        f"shape_{name}"
        for name in (
            "count", "rms_mm", "bias_mm", "largest_mm", "score_rms", "expected_count", "valid_fraction",
            "false_valid_count",
        )
    }  # fmt: skip


def test_noise_of_the_predicted_size_scores_one(rng: np.random.Generator) -> None:
    noise = rng.normal(size=(4, 3, 128, 128))
    found, _ = assessed(
        DEFORMED,
        shape=cloud("S01", SIGMA_MM * noise[0]),
        displacement=displacement(SIGMA_MM * noise[1]),
        strain=strain(SIGMA_STRAIN * noise[2]),
    )
    assert found.displacement is not None
    assert found.strain is not None
    for errors, sigma in (
        (found.shape, SIGMA_MM * np.sqrt(3)),
        (found.displacement, SIGMA_MM * np.sqrt(3)),
        (found.strain, SIGMA_STRAIN),
    ):
        # 3 x 10,000 normal numbers: 1 / sqrt(2 n) = 0.4 %, five of those.
        assert errors.score_rms == pytest.approx(1.0, abs=0.02)
        assert errors.rms == pytest.approx(sigma, rel=0.02)
        assert errors.bias < 5.0 * sigma / np.sqrt(errors.count)


def test_a_shift_is_bias_and_a_small_strain_is_held_against_small_strain() -> None:
    shift = np.array([0.3, 0.0, 0.4])[:, None, None]
    found, statistics = assessed(
        DEFORMED, shape=cloud("S01", shift), displacement=displacement(), strain=strain(1e-3, "small")
    )
    assert found.shape.rms == pytest.approx(0.5)
    assert found.shape.bias == pytest.approx(0.5)
    assert statistics["shape_bias_mm"] == pytest.approx(0.5)
    assert found.strain is not None
    assert found.strain.rms == pytest.approx(1e-3)
    assert found.strain.bias == pytest.approx(1e-3)
    assert np.nanmax(found.shape_error) == pytest.approx(0.5)


def test_one_wild_pixel_is_counted_and_one_beside_the_plate_is_told_apart() -> None:
    good = cloud("S00")
    seen = np.argwhere(shape("S00").seen)
    nothing = np.argwhere(~shape("S00").seen)
    xyz, reason = good.position.copy(), good.reason.copy()
    xyz[2, *seen[0]] += 100.0
    xyz[:, *nothing[0]] = 5.0
    reason[*nothing[0]] = Reason.VALID
    reason[*seen[1]] = Reason.HIGH_PHASE_ERROR
    found, _ = assessed(REFERENCE, shape=replace(good, position=xyz, reason=reason))
    assert found.shape.count == len(seen) - 1
    assert found.shape.largest == pytest.approx(100.0)
    assert found.shape.rms == pytest.approx(100.0 / np.sqrt(len(seen) - 1))
    assert found.shape.false_valid_count == 1
    assert found.shape.valid_fraction == pytest.approx(1.0 - 1.0 / len(seen))
    assert np.isnan(found.shape_error[*seen[1]])


def test_a_result_without_a_valid_pixel_has_no_numbers() -> None:
    good = cloud("S00")
    found, statistics = assessed(REFERENCE, shape=replace(good, reason=np.ones_like(good.reason)))
    assert np.isnan(found.shape.rms)
    assert found.shape.valid_fraction == 0.0
    assert "shape_rms_mm" not in statistics


def test_only_simulated_campaigns_have_a_truth() -> None:
    assert default_subjects(KIND, replace(CAMPAIGN, scene=None)) == ()
    assert len(default_subjects(KIND, CAMPAIGN)) == 4
    real = Held(REFERENCE, {"measurement": replace(measurement("S00"), simulation=None)})
    inputs = Inputs(REFERENCE, None, {"measurement": real})
    with pytest.raises(InvalidInput, match="was not simulated"):
        next(KIND.run(inputs, AssessParameters(), lambda fraction, message="": None))
