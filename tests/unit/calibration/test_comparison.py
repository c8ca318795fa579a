"""What changed between two calibrations, and whether it matters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.calibration.checking.comparison import (
    CalibrationComparison,
    compare_calibrations,
    parameter_change,
)
from sms_jobs.metrology.calibration.pair_points import Parameters, moved_sensor
from sms_jobs.metrology.calibration.rigid_alignment import align_points, rigid_modes
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import compose, inverse, rotation_matrix, transform

Floats = NDArray[np.float64]

DOWN = np.array([0.0, -1.0, 0.0])
RIG: dict[str, Parameters] = {
    "C1": (
        Intrinsics(1500.0, 1500.0, 511.5, 383.5, -0.1, 0.05),
        Pose.looking_at(np.array([-300.0, 0.0, -1000.0]), np.zeros(3), DOWN),
    ),
    "C2": (
        Intrinsics(1520.0, 1519.0, 505.0, 390.0, -0.08, 0.02),
        Pose.looking_at(np.array([320.0, 20.0, -980.0]), np.zeros(3), DOWN),
    ),
    "P1": (
        Intrinsics(1400.0, 1405.0, 500.0, 420.0, 0.05, -0.02, 1e-4, -2e-4),
        Pose.looking_at(np.array([0.0, 50.0, -1050.0]), np.zeros(3), DOWN),
    ),
}
PAIRS = (("C1", "P1"), ("C2", "P1"))
VOLUME = (np.full(3, -120.0), np.full(3, 120.0))
ONE = np.zeros(PER_SENSOR)
ONE[:12] = [2e-5, 2e-5, 2e-5, 0.02, 0.02, 0.02, 0.3, 0.3, 0.3, 0.3, 2e-4, 1e-3]
SIGMA = np.tile(ONE, 3)
ALL = len(SIGMA)


def changed(step: Floats) -> dict[str, Parameters]:
    steps = np.split(step, len(RIG))
    return {n: moved_sensor(s, own) for (n, s), own in zip(RIG.items(), steps, strict=True)}


def compare(after: dict[str, Parameters], **more: Any) -> CalibrationComparison:
    more.setdefault("tolerance_mm", 0.05)
    return compare_calibrations(RIG, after, PAIRS, VOLUME, **more)


def covariance(rng: np.random.Generator) -> Floats:
    """Return a covariance with correlations and the deviations SIGMA."""
    mix = rng.standard_normal((ALL, 2 * ALL))
    c = mix @ mix.T
    return np.asarray(c / np.sqrt(np.outer(np.diag(c), np.diag(c))) * np.outer(SIGMA, SIGMA))


def root(c: Floats) -> Floats:
    values, vectors = np.linalg.eigh(c)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def test_alignment_is_the_rigid_motion(rng: np.random.Generator) -> None:
    points = rng.uniform(-100.0, 100.0, (30, 3))
    motion = Pose.from_arrays(rotation_matrix(np.array([1.0, -2.0, 0.5])), np.array([10.0, 20.0, -30.0]))
    found = align_points(points, transform(motion, points))
    np.testing.assert_allclose(found.matrix(), motion.matrix(), atol=1e-12)
    np.testing.assert_allclose(found.translation, motion.translation, atol=1e-10)
    mirrored = align_points(points, points * [1.0, 1.0, -1.0])
    assert np.linalg.det(mirrored.matrix()) == pytest.approx(1.0)
    small = np.array([1e-6, -2e-6, 3e-6, 0.1, 0.2, -0.3])
    moved = points @ rotation_matrix(small[:3]).T + small[3:]
    np.testing.assert_allclose(
        rigid_modes(points) @ small, moved - points, atol=1e-9
    )  # second order: 1e-9 mm
    with pytest.raises(InvalidInput, match="3 pairs"):
        align_points(points[:2], points[:2])


def test_nothing_changed_is_nothing() -> None:
    found = compare(dict(RIG))
    assert found.verdict == "harmless"  # without covariances no chance is known
    assert max(abs(c.change) for c in found.changes) == 0.0
    for pair in found.pairs:
        assert pair.points == 343
        assert pair.largest_mm < 1e-8  # Newton on the distortion ends at 1e-14 of the focal length


def test_another_world_is_no_change_of_shape() -> None:
    motion = Pose.from_arrays(rotation_matrix(np.array([0.3, 0.1, -0.2])), np.array([50.0, -20.0, 10.0]))
    after = {n: (i, compose(p, inverse(motion))) for n, (i, p) in RIG.items()}
    found = compare(after, same_world=False)
    assert found.verdict == "harmless"
    for pair in found.pairs:
        assert pair.rms_mm > 10.0
        assert pair.aligned_largest_mm < 1e-8
    np.testing.assert_allclose(found.alignment.matrix(), motion.matrix().T, atol=1e-10)
    assert max(abs(c.change) for c in found.changes) < 1e-8
    assert found.turn_rad == pytest.approx(np.sqrt(0.14), rel=1e-9)


def test_a_known_change_is_told_and_matters() -> None:
    step = np.zeros(ALL)
    step[2 * PER_SENSOR + 6 : 2 * PER_SENSOR + 8] = 14.0, 14.05  # P1's focal length by 1 %
    step[0] = 1e-4
    found = compare(changed(step))
    by_name = {(c.sensor, c.parameter): c.change for c in found.changes}
    assert by_name["P1", "fx"] == pytest.approx(14.0)
    assert by_name["C1", "rx"] == pytest.approx(1e-4, rel=1e-6)
    assert by_name["C2", "rx"] == 0.0
    assert found.verdict == "matters"
    assert "C1P1" in found.reason or "C2P1" in found.reason
    for pair in found.pairs:
        assert pair.rms_mm < pair.largest_mm
        assert 0.05 < pair.aligned_rms_mm < pair.aligned_largest_mm
    # One motion for all pairs: least over both together.
    assert sum(p.aligned_rms_mm**2 for p in found.pairs) < sum(p.rms_mm**2 for p in found.pairs)
    np.testing.assert_allclose(
        parameter_change(RIG["C1"], changed(step)["C1"]), step[:PER_SENSOR], atol=1e-12
    )


def test_differences_scatter_as_the_covariance_says(rng: np.random.Generator) -> None:
    c1, c2 = covariance(rng), 0.5 * covariance(rng)
    draw = root(c1 + c2)
    p, rms, aligned, expected, z = [], [], [], [], []
    for _ in range(60):
        found = compare(changed(draw @ rng.standard_normal(ALL)), covariance_before=c1, covariance_after=c2)
        p.append(found.p_value)
        rms.append(found.pairs[0].rms_mm)
        aligned.append(found.pairs[0].aligned_rms_mm)
        expected = [found.pairs[0].expected_rms_mm, found.pairs[0].expected_aligned_rms_mm]
        z += [c.z for c in found.changes if np.isfinite(c.z)]
    assert found.freedom == 36
    # p is uniform: mean 0.5, standard deviation 0.289 / sqrt(60) = 0.037; four of these.
    assert np.mean(p) == pytest.approx(0.5, abs=0.15)
    # 60 x 36 correlated z, at least 60 x 20 independent: 2 % of rms, four of these.
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.08)
    # The mean square distance has few degrees of freedom a draw, five or more: sqrt(2 / 300) / 2 = 4 % of the
    # rms, and four of these.
    assert np.sqrt(np.mean(np.square(rms))) == pytest.approx(expected[0], rel=0.16)
    assert np.sqrt(np.mean(np.square(aligned))) == pytest.approx(expected[1], rel=0.16)


def test_an_update_is_tested_by_what_it_learnt(rng: np.random.Generator) -> None:
    before = covariance(rng)
    free = SIGMA > 0.0
    # New observations of 20 combinations of the parameters, as good as the prior knows them.
    rows = rng.standard_normal((20, int(free.sum()))) / SIGMA[free] / 6.0
    prior = before[np.ix_(free, free)]
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + np.eye(20))
    after = np.zeros((ALL, ALL))
    after[np.ix_(free, free)] = prior - gain @ rows @ prior
    p = []
    for _ in range(60):
        # Truth scatters about the earlier calibration; the later one is Kalman's update of it.
        truth = root(prior) @ rng.standard_normal(int(free.sum()))
        step = np.zeros(ALL)
        step[free] = gain @ (rows @ truth + rng.standard_normal(20))
        found = compare(changed(step), covariance_before=before, covariance_after=after, relation="updated")
        p.append(found.p_value)
    assert found.freedom == 20
    assert np.mean(p) == pytest.approx(0.5, abs=0.15)  # uniform, as above
    independent = compare(changed(step), covariance_before=before, covariance_after=after)
    assert independent.p_value > 0.9  # far too lenient: the two are anything but independent


def test_verdicts_follow_chance_and_tolerance(rng: np.random.Generator) -> None:
    c = covariance(rng)
    known = {"covariance_before": c, "covariance_after": c}
    by_chance = root(2.0 * c) @ rng.standard_normal(ALL)
    assert compare(changed(by_chance), tolerance_mm=10.0, **known).verdict == "unchanged"
    assert compare(changed(by_chance), tolerance_mm=1e-4, **known).verdict == "cannot tell"
    assert compare(changed(30.0 * by_chance), tolerance_mm=1e-4, **known).verdict == "matters"
    assert compare(changed(30.0 * by_chance), tolerance_mm=100.0, **known).verdict == "harmless"


def test_calibrations_that_cannot_be_compared_are_refused(rng: np.random.Generator) -> None:
    with pytest.raises(InvalidInput, match="C2"):
        compare({n: s for n, s in RIG.items() if n != "C2"})
    with pytest.raises(InvalidInput, match="both or none"):
        compare(dict(RIG), covariance_before=covariance(rng))
    with pytest.raises(InvalidInput, match=f"{ALL} x {ALL}"):
        compare(dict(RIG), covariance_before=np.eye(2 * PER_SENSOR), covariance_after=np.eye(2 * PER_SENSOR))
    with pytest.raises(InvalidInput, match="0 places"):
        compare_calibrations(
            RIG, RIG, PAIRS, (np.array([0, 0, -5e3]), np.array([1, 1, -4e3])), tolerance_mm=0.1
        )


def test_a_sensor_that_moved_does_not_accuse_the_others(rng: np.random.Generator) -> None:
    rig = RIG | {"P2": (RIG["P1"][0], moved_sensor(RIG["C1"], 20.0 * np.eye(PER_SENSOR)[4])[1])}
    motion = Pose.from_arrays(rotation_matrix(np.array([0.3, 0.1, -0.2])), np.array([50.0, -20.0, 10.0]))
    turned = rig | {"P1": moved_sensor(rig["P1"], 4e-4 * np.eye(PER_SENSOR)[1])}
    after = {n: (i, compose(p, inverse(motion))) for n, (i, p) in turned.items()}
    # Sensors known to a hundredth of a mm and a few microradian, in part together.
    mix = rng.standard_normal((4 * PER_SENSOR, 8 * PER_SENSOR))
    c = mix @ mix.T / np.outer(np.linalg.norm(mix, axis=1), np.linalg.norm(mix, axis=1))
    sigma = np.tile(0.01 * ONE, 4)
    c *= np.outer(sigma, sigma)
    found = compare_calibrations(
        rig,
        after,
        [(camera, p) for camera in ("C1", "C2") for p in ("P1", "P2")],
        VOLUME,
        covariance_before=c,
        covariance_after=c,
        same_world=False,
        tolerance_mm=0.05,
    )
    assert found.verdict == "matters"
    assert "a change of P1 alone explains 100%" in found.reason
    # Nothing else changed, and nothing was measured: what stayed is exact, to the rounding of millimetres.
    stayed = [p for p in found.pairs if p.projector == "P2"]
    assert max(p.aligned_largest_mm for p in stayed) < 1e-6
    assert max(abs(ch.change) for ch in found.changes if ch.sensor != "P1") < 1e-6
    assert min(p.aligned_rms_mm for p in found.pairs if p.projector == "P1") > 0.05
