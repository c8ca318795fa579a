"""The bundle adjustment as a whole: against an independent solver, the truth, and its own claims."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sms_jobs.bench.sessions.bar_session import TABLE_3, BarSession, SessionDesign, bar_session
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.covariance import point_covariance
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions, BundleProblem, SensorPrior
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.calibration.bundle.weights import Consistency
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import KEPT, LENS, Intrinsics, pixel_jacobian
from sms_jobs.metrology.geometry.transforms import transform

Floats = NDArray[np.float64]

PLAIN = BundleOptions(huber=np.inf, reject=np.inf, estimate_variances=False, least_incidence=0.0)
TILTS = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, -0.3, 0.2))
SMALL = SessionDesign(points=30, camera_pixels=512, angles=TABLE_3[::2], board_tilts=TILTS)
"""13 bar poses, 3 board poses, 3120 points on spheres, 1980 on boards."""

FREE = np.array([name not in KEPT for name in LENS])
"""Which parameters of a lens are estimated."""


@cache
def session(seed: int, design: SessionDesign = SMALL) -> BarSession:
    return bar_session(design, seed)


@cache
def adjusted(seed: int) -> Adjustment:
    return adjust(session(seed).problem)


class PlainResiduals:
    """The residuals of a problem as anybody would write them, with the camera model of the rest of the house.

    Everything is free but what the problem fixes: the pose of the first board, and what lenses keep.
    """

    def __init__(self, problem: BundleProblem) -> None:
        self.problem = problem

    def units(self) -> Floats:
        """Return steps that change images by about a pixel."""
        p = self.problem
        pose = [1e-4] * 3 + [0.1] * 3
        corner = pixel_jacobian(p.sensors[0].intrinsics, np.array([[0.3, 0.2]]))
        lens = 1.0 / np.abs(corner).max(axis=(0, 1))
        sensors = [*pose, *lens[FREE]] * len(p.sensors)
        boards = pose * (len(p.board_poses) - 1)
        return np.array(sensors + boards + [0.1] * (6 * len(p.bar_poses)) + [0.01] * 3 + [1e-4])

    def read(
        self, x: Floats
    ) -> tuple[list[tuple[Intrinsics, Pose]], list[Pose], Floats, float, Floats, float]:
        p, at = self.problem, 0
        sensors, boards = [], [p.board_poses[0].pose]
        for s in p.sensors:
            d = x[at : at + 6 + FREE.sum()]
            lens = s.intrinsics.vector()
            lens[FREE] += d[6:]
            sensors.append((Intrinsics.from_vector(lens), self.turned(s.pose, d[:6])))
            at += len(d)
        for b in p.board_poses[1:]:
            boards.append(self.turned(b.pose, x[at : at + 6]))
            at += 6
        centres = np.array([b.centres for b in p.bar_poses])
        centres = centres + x[at : at + centres.size].reshape(centres.shape)
        length, radius1, radius2, scale = x[-4:]
        bar = p.bars[0]
        radii = bar.radius_mm + np.array([radius1, radius2])
        return sensors, boards, centres, bar.length_mm + length, radii, 1.0 + scale

    @staticmethod
    def turned(pose: Pose, d: Floats) -> Pose:
        turn = Rotation.from_rotvec(d[:3]).as_matrix()
        return Pose.from_arrays(turn @ pose.matrix(), np.array(pose.translation) + d[3:])

    def __call__(self, x: Floats) -> Floats:
        sensors, boards, centres, length, radii, scale = self.read(x)
        bar, board = self.problem.bars[0], self.problem.boards[0]
        found = []
        for seen in self.problem.bar_points:
            camera, projector = sensors[seen.camera], sensors[seen.projector]
            u = ray_directions(*camera, seen.camera_px)
            c = centres[seen.pose][seen.sphere - 1] - camera[1].centre()
            towards = np.sum(u * c, axis=1)
            half = towards**2 - np.sum(c * c, axis=1) + radii[seen.sphere - 1] ** 2
            points = camera[1].centre() + (towards - np.sqrt(half))[:, None] * u
            off = project(*projector, points) - seen.projector_px
            found.append((off / seen.sigma_px[:, None]).ravel())
        for points_ in self.problem.board_points:
            sensor = sensors[points_.sensor]
            world = transform(boards[points_.pose], scale * points_.point)
            off = project(*sensor, world) - points_.pixel
            found.append((off / points_.sigma_px[:, None]).ravel())
        apart = np.linalg.norm(centres[:, 1] - centres[:, 0], axis=1)
        found.append((apart - length) / bar.repeatability_mm)
        found.append([(length - bar.length_mm) / bar.length_sigma_mm])
        found.append((radii - bar.radius_mm) / bar.radius_sigma_mm)
        found.append([(scale - 1.0) / board.pitch_relative_sigma])
        return np.concatenate(found)


@pytest.mark.long  # the solver takes 20 s
def test_an_independent_solver_finds_the_same_optimum() -> None:
    design = SessionDesign(
        points=12,
        camera_pixels=512,
        angles=TABLE_3[::4],
        board_tilts=TILTS[:2],
        point_sigma_mm=0.0,
        start=0.1,
    )
    problem = session(3, design).problem
    found = adjust(problem, replace(PLAIN, cost_tolerance=1e-13))
    plain = PlainResiduals(problem)
    units = plain.units()

    def slopes(x: Floats) -> Floats:
        # Over 1e-2 px: rounding of 1e-13 px makes 1e-11 of a slope, the third order less than 1e-8.
        steps = 1e-2 * np.eye(len(x))
        return np.stack([(plain((x + d) * units) - plain((x - d) * units)) / 2e-2 for d in steps], axis=1)

    independent = least_squares(
        lambda x: plain(x * units),
        np.zeros_like(units),
        slopes,
        method="lm",
        ftol=1e-13,
        xtol=1e-13,
        gtol=1e-13,
    )
    # The target: 1e-8 of the cost.
    assert found.cost == pytest.approx(independent.cost, rel=1e-8)
    sensors, *_ = plain.read(independent.x * units)
    sigma = np.sqrt(np.diag(found.covariance))
    for k, (intrinsics, pose) in enumerate(sensors):
        # A step of 1e-8 of a cost of 1000 is less than sqrt(2e-5) of a standard deviation.
        assert abs(found.sensors[k].intrinsics.fx - intrinsics.fx) < 5e-3 * sigma[PER_SENSOR * k + 6]
        off = np.subtract(found.sensors[k].pose.translation, pose.translation)
        assert np.all(np.abs(off) < 5e-3 * sigma[PER_SENSOR * k + 3 : PER_SENSOR * k + 6])
    # Its covariance is the inverse of J^T J, about 1e-6 of each slope; small rotations are counted from the
    # start there and from the end here, and so mixed by as much as they differ.
    own = np.sqrt(np.diag(np.linalg.inv(independent.jac.T @ independent.jac))) * units
    same = np.array(["r" not in name.rpartition(".")[2][:1] for name in found.names])[found.free]
    np.testing.assert_allclose(sigma[found.free][same], own[same], rtol=1e-3)


def self_ordered(problem: BundleProblem, sigma: Floats) -> Floats:
    """Return the deviations of `PlainResiduals` in the order of the adjustment: they are the same."""
    return sigma


def test_the_truth_is_found_within_what_is_stated() -> None:
    made, found = session(1), adjusted(1)
    sigma = np.sqrt(np.diag(found.covariance))
    true_lenses = np.concatenate([s.intrinsics.vector()[FREE] for s in made.sensors])
    got = np.concatenate([s.intrinsics.vector()[FREE] for s in found.sensors])
    own = sigma[: 4 * PER_SENSOR].reshape(4, PER_SENSOR)[:, 6:][:, FREE].ravel()
    # 32 correlated numbers: none beyond 4.5 sigma.
    assert np.max(np.abs(got - true_lenses) / own) < 4.5
    at = [k for k, name in enumerate(found.names) if ".sphere" in name]
    z = (found.centres - made.centres).ravel() / sigma[at]
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6  # 78 numbers that share the frame's error
    assert found.warnings == ()
    assert found.gauge == "board frame of pose B01"
    for factor in found.variance_factors.values():
        # 3120 residuals and more give a factor to 1.3 %, 1/3 less for what Huber clips; four of those.
        assert factor == pytest.approx(1.0, abs=0.06)
    # Residuals less parameters, 10 200 - 150 or so.
    assert found.cost == pytest.approx(0.5 * found.redundancy, rel=0.06)


@pytest.mark.parametrize("start", [4.0, 6.0])
def test_a_start_far_off_leads_to_the_same_minimum(start: float) -> None:
    # 6e-3 rad, 12 mm and 20 px, every sensor another way: what a bad first guess leaves.
    near, far = adjusted(5), adjust(bar_session(replace(SMALL, start=start), 5).problem)
    # Both draw the same noise, and the start from the same numbers.
    assert far.cost == pytest.approx(near.cost, rel=1e-6)
    assert far.iterations < 40


def test_threads_change_nothing() -> None:
    one = adjusted(1)
    two = adjust(session(1).problem, BundleOptions(threads=2))
    np.testing.assert_array_equal(one.centres, two.centres)
    np.testing.assert_array_equal(one.covariance, two.covariance)


def triangulated(
    camera: tuple[Intrinsics, Pose], projector: tuple[Intrinsics, Pose], pixels: tuple[Floats, Floats]
) -> Floats:
    u, v = ray_directions(*camera, pixels[0]), ray_directions(*projector, pixels[1])
    base, n = projector[1].centre() - camera[1].centre(), np.cross(u, v)
    along = np.sum(np.cross(base, v) * n, axis=1) / np.sum(n * n, axis=1)
    return np.asarray(camera[1].centre() + along[:, None] * u)


@pytest.mark.parametrize("calibrations", [5, pytest.param(20, marks=pytest.mark.long)])
def test_points_scatter_as_predicted_over_many_calibrations(calibrations: int) -> None:
    grid = np.stack(np.meshgrid(*[[-180.0, 0.0, 180.0]] * 3), axis=-1).reshape(-1, 3)
    z = []
    for seed in range(1, calibrations + 1):
        made, found = session(seed), adjusted(seed)
        for c, p in ((0, 2), (0, 3), (1, 2), (1, 3)):
            true = [made.sensors[k] for k in (c, p)]
            pixels = [project(s.intrinsics, s.pose, grid) for s in true]
            own = [(found.sensors[k].intrinsics, found.sensors[k].pose) for k in (c, p)]
            error = triangulated(own[0], own[1], (pixels[0], pixels[1])) - grid
            covariance = point_covariance(found, true[0].name, true[1].name, grid)
            z.append(error / np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    # The target. Each calibration has some ten independent directions: 20 give it to 1 / sqrt(2 * 200) = 5 %,
    # 5 to 10 %; four of those.
    off = 4.0 / np.sqrt(2.0 * 10.0 * calibrations)
    assert 1.0 - off < np.sqrt(np.mean(np.square(z))) < 1.0 + off


def test_the_covariance_of_a_point_is_symmetric_and_positive() -> None:
    found = adjusted(1)
    covariance = point_covariance(found, "C1", "P2", np.array([[0.0, 0.0, 0.0], [200.0, 100.0, -50.0]]))
    np.testing.assert_allclose(covariance, covariance.transpose(0, 2, 1), atol=1e-9 * np.max(covariance))
    assert np.all(np.linalg.eigvalsh(covariance) > 0.0)


def test_outliers_are_left_out_and_counted() -> None:
    made = session(2)
    rng = np.random.default_rng(5)
    points = []
    wrong = 0
    for seen in made.problem.bar_points:
        bad = rng.random(len(seen.sphere)) < 0.03
        wrong += int(bad.sum())
        shift = np.where(bad[:, None], rng.uniform(2.0, 30.0, (len(bad), 2)), 0.0)
        points.append(replace(seen, projector_px=seen.projector_px + shift))
    found = adjust(replace(made.problem, bar_points=tuple(points)))
    clean = adjusted(2)
    rejected = sum(found.refused.values())
    # Every shift is 40 sigma and more; of 3000 good ones exp(-18) each lie beyond 6 sigma.
    assert rejected == wrong
    assert found.refused["sphere point with a residual beyond 6 sigma"] == wrong
    sigma = np.sqrt(np.diag(clean.covariance))[: PER_SENSOR * 4]
    for k in range(4):
        off = found.sensors[k].intrinsics.fx - clean.sensors[k].intrinsics.fx
        # Without 3 % of the points an estimate moves by sqrt(0.03) of its deviation; four of those.
        assert abs(off) < 4.0 * np.sqrt(0.03) * sigma[PER_SENSOR * k + 6]
    flagged = sum(int((~used).sum()) for used in found.used_bar)
    assert flagged == wrong


def test_variances_are_estimated_for_each_type() -> None:
    made = session(4)
    stated = replace(
        made.problem,
        bar_points=tuple(replace(p, sigma_px=p.sigma_px / 2.0) for p in made.problem.bar_points),
        board_points=tuple(
            replace(p, sigma_px=p.sigma_px * (4.0 if p.projector else 1.0)) for p in made.problem.board_points
        ),
    )
    found, before = adjust(stated).variance_factors, adjusted(4).variance_factors
    # 0.0412 px is stated where 0.0201 px is right, the board's own 0.002 mm being 0.002 to 0.003 px of it.
    for kind, factor in (("ray gap", 2.0), ("sphere surface", 2.0), ("board in camera", 1.0),
                         ("board in projector", 0.25)):  # fmt: skip
        assert found[kind] / before[kind] == pytest.approx(factor, rel=0.02)  # type: ignore[index]


def test_huber_weights_are_consistent(rng: np.random.Generator) -> None:
    expected = Consistency.of(2.0)
    r = rng.standard_normal((400_000, 2))
    d = np.hypot(*r.T)
    w = np.minimum(1.0, 2.0 / d)
    # 400 000 samples of numbers about 1 give a mean to 0.2 %; four of those.
    assert expected.weight == pytest.approx(np.mean(w), rel=0.008)
    assert expected.power == pytest.approx(np.mean(w**2 * d**2) / 2.0, rel=0.008)
    slope = np.where(d < 2.0, 1.0, 1.0 / d)
    assert expected.slope == pytest.approx(np.mean(slope), rel=0.008)
    assert Consistency.of(3.0).correction == pytest.approx(1.0, abs=0.01)


def test_without_a_board_the_first_sensor_is_the_frame() -> None:
    made = session(6, SessionDesign(points=40, camera_pixels=512, board_tilts=()))
    found = adjust(made.problem)
    assert found.gauge == "pin-hole frame of C1"
    assert not found.free[:6].any()
    np.testing.assert_array_equal(found.free[6:PER_SENSOR], FREE)
    np.testing.assert_array_equal(found.sensors[0].pose.translation, made.problem.sensors[0].pose.translation)
    apart = np.linalg.norm(found.centres[:, 1] - found.centres[:, 0], axis=1)
    true = np.linalg.norm(made.centres[:, 1] - made.centres[:, 0], axis=1)
    # The repeatability of 0.5 um ties all poses to one length, known to 2 um.
    np.testing.assert_allclose(apart, true, atol=4 * 0.002)


def test_an_aspect_can_be_kept() -> None:
    made = session(1)
    sensors = tuple(replace(s, fixed_aspect=True, fixed=("p1", "p2", *KEPT)) for s in made.problem.sensors)
    found = adjust(replace(made.problem, sensors=sensors))
    for old, new in zip(sensors, found.sensors, strict=True):
        ratio = old.intrinsics.fy / old.intrinsics.fx
        assert new.intrinsics.fy / new.intrinsics.fx == pytest.approx(ratio, rel=1e-12)
        assert (new.intrinsics.p1, new.intrinsics.p2) == (old.intrinsics.p1, old.intrinsics.p2)
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[7] == pytest.approx(sigma[6] * sensors[0].intrinsics.fy / sensors[0].intrinsics.fx)
    assert not sigma[[found.names.index(f"C1.{name}") for name in ("p1", "p2", *KEPT)]].any()


def test_a_recalibration_on_site_combines_old_and_new() -> None:
    before = adjusted(1)
    count = 4 * PER_SENSOR
    free = before.free[:count]
    # What an earlier adjustment leaves; nothing is said of parameters that were fixed.
    information = np.zeros((count, count))
    information[np.ix_(free, free)] = np.linalg.inv(before.covariance[np.ix_(free, free)])
    prior = SensorPrior(information)
    boards = session(9, SessionDesign(angles=(), camera_pixels=512, board_tilts=TILTS)).problem
    sensors = tuple(
        replace(old, intrinsics=new.intrinsics, pose=new.pose)
        for old, new in zip(boards.sensors, before.sensors, strict=True)
    )
    problem = replace(boards, sensors=sensors, world_board=None, prior=prior)
    found = adjust(problem, PLAIN)
    assert found.gauge == "frame of the prior calibration"
    old, new = (np.diag(a.covariance)[:count][free] for a in (before, found))
    # Information adds up: nothing is known worse than before.
    assert np.all(new <= old * (1.0 + 1e-6))
    assert np.sum(new) < np.sum(old)
    alone = replace(
        problem, board_points=problem.board_points[:1], prior=SensorPrior(1e6 * prior.information)
    )
    kept = adjust(alone, PLAIN)
    # With a prior a thousand times as sharp, one view moves nothing by more than some thousandths.
    moved = [a.intrinsics.fx - b.intrinsics.fx for a, b in zip(kept.sensors, before.sensors, strict=True)]
    assert np.max(np.abs(moved) / np.sqrt(np.diag(before.covariance)[6:count:PER_SENSOR])) < 0.01
