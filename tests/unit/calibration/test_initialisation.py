"""First values of a calibration, from simulated views of a board."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.board_adjustments import board_problem

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.calibration.board_views import BoardView
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.sensor_derivatives import project_with_derivatives
from sms_jobs.metrology.calibration.starting.initialisation import InitialCalibration, initialise
from sms_jobs.metrology.calibration.starting.planar_intrinsics import (
    intrinsics_from_homographies,
    pose_from_homography,
)
from sms_jobs.metrology.calibration.starting.sensor_refinement import SeenPoints, refine_sensor
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import compose, inverse, rotation_matrix, transform

Floats = NDArray[np.float64]

SIZES = {"C1": (1280, 1024), "C2": (1280, 1024), "P1": (1024, 768)}
LENSES = {
    "C1": Intrinsics(1850.0, 1852.0, 645.0, 505.0, -0.12, 0.15, 2e-4, -3e-4),
    "C2": Intrinsics(1800.0, 1801.0, 628.0, 520.0, -0.10, 0.08, -2e-4, 1e-4),
    "P1": Intrinsics(1500.0, 1499.0, 515.0, 700.0, 0.05, -0.06),  # lens shift: looks upwards
}
DOWN = np.array([0.0, -1.0, 0.0])
RIG = {
    "C1": Pose.looking_at(np.array([-250.0, 0.0, -900.0]), np.zeros(3), DOWN),
    "C2": Pose.looking_at(np.array([260.0, 20.0, -880.0]), np.zeros(3), DOWN),
    "P1": Pose.looking_at(np.array([10.0, 150.0, -950.0]), np.array([0.0, 120.0, 0.0]), DOWN),
}
SIGMA = 0.05


def grid(columns: int = 13, rows: int = 10, pitch: float = 15.0) -> Floats:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * pitch


def poses(count: int, rng: np.random.Generator, tilt: float = 0.5) -> list[Pose]:
    """Return board poses about the rig's origin, tilted about either axis by up to `tilt` in rad."""
    found = []
    for i in range(count):
        turn = rotation_matrix(np.array([*rng.uniform(-tilt, tilt, 2), rng.uniform(-0.2, 0.2)]))
        if i == 0:
            turn = rotation_matrix(np.array([0.35, -0.3, 0.05])) if tilt else turn
        middle = np.array([rng.uniform(-20, 20), rng.uniform(-20, 20), rng.uniform(-60, 60)])
        found.append(Pose.from_arrays(turn, middle - turn @ np.array([90.0, 67.5, 0.0])))
    return found


def views_of(
    boards: list[Pose],
    rng: np.random.Generator,
    *,
    sensors: tuple[str, ...] = ("C1", "C2", "P1"),
    sigma: float = SIGMA,
    rig: dict[str, Pose] | None = None,
) -> list[BoardView]:
    points, found = grid(), []
    for i, name in itertools.product(range(len(boards)), sensors):
        pixel = project(LENSES[name], (rig or RIG)[name], transform(boards[i], points))
        pixel = pixel + sigma * rng.standard_normal(pixel.shape)
        found.append(BoardView(name, f"B{i:02d}", points, pixel, np.full(len(points), sigma)))
    return found


def worst_reprojection(found: InitialCalibration, boards: list[Pose], sensors: tuple[str, ...]) -> float:
    """Return the largest rms in px of exact points through the found sensors, over sensors.

    The found world is the first board's frame.
    """
    worst = 0.0
    for name in sensors:
        seen = found.sensors[name]
        points = np.concatenate([transform(b, grid()) for b in boards])
        moved = transform(inverse(boards[0]), points)
        off = project(seen.intrinsics, seen.pose, moved) - project(LENSES[name], RIG[name], points)
        worst = max(worst, float(np.sqrt(np.mean(off**2))))
    return worst


def test_derivatives_are_those_of_finite_differences(rng: np.random.Generator) -> None:
    lens = Intrinsics(900.0, 950.0, 500.0, 400.0, -0.2, 0.1, 1e-3, -2e-3, 0.05)
    pose = Pose.from_arrays(rotation_matrix(np.array([0.2, -0.3, 0.1])), np.array([20.0, -30.0, 800.0]))
    points = rng.uniform(-200.0, 200.0, (30, 3))
    pixels, by_pose, by_lens = project_with_derivatives(lens, pose, points)
    np.testing.assert_allclose(pixels, project(lens, pose, points), atol=1e-9)
    values = lens.vector()
    for k in range(len(values)):
        step = 1e-4 * np.eye(len(values))[k] * (1e3 if k < 4 else 1.0)
        up, down = (project(Intrinsics(*(values + s * step)), pose, points) for s in (1, -1))
        # Linear in each of these parameters: only rounding of 1e3 / 1e-4 x 1e-16 = 1e-9 px remains.
        np.testing.assert_allclose(by_lens[:, :, k], (up - down) / (2 * step[k]), rtol=1e-6, atol=1e-7)
    for k in range(6):
        step = np.eye(6)[k] * (1e-5 if k < 3 else 1e-2)
        up, down = (
            project(
                lens,
                Pose.from_arrays(
                    rotation_matrix(s * step[:3]) @ pose.matrix(), np.array(pose.translation) + s * step[3:]
                ),
                points,
            )
            for s in (1, -1)
        )
        # Second-order terms of 1e-10 relative, rounding 1e-13 x 1e3 / 1e-5 = 1e-5 px per rad of 1e3.
        np.testing.assert_allclose(by_pose[:, :, k], (up - down) / (2 * step[k]), rtol=1e-6, atol=1e-4)


def test_zhang_is_exact_without_noise_and_distortion(rng: np.random.Generator) -> None:
    lens = Intrinsics(1500.0, 1400.0, 700.0, 450.0)
    views = [compose(RIG["C1"], b) for b in poses(4, rng)]
    homographies = [lens.matrix() @ np.column_stack([v.matrix()[:, :2], v.translation]) for v in views]
    found = intrinsics_from_homographies(
        homographies, (639.5, 511.5), square_pixels=False, known_principal_point=False
    )
    # Rounding, magnified by the condition of the equations of about 1e3.
    np.testing.assert_allclose(found.matrix(), lens.matrix(), rtol=1e-8)
    for h, view in zip(homographies, views, strict=True):
        again = pose_from_homography(h, found)
        np.testing.assert_allclose(again.matrix(), view.matrix(), atol=1e-8)
        np.testing.assert_allclose(again.translation, view.translation, rtol=1e-7)
    square = Intrinsics(1500.0, 1500.0, 639.5, 511.5)
    one = [square.matrix() @ np.column_stack([views[0].matrix()[:, :2], views[0].translation])]
    assert intrinsics_from_homographies(one, (639.5, 511.5)).fx == pytest.approx(1500.0, rel=1e-9)
    with pytest.raises(CalibrationFailed, match="2 equations for 3"):
        intrinsics_from_homographies(one, (639.5, 511.5), known_principal_point=False)


def test_every_sensor_is_found_to_a_fraction_of_a_pixel(rng: np.random.Generator) -> None:
    boards = poses(8, rng)
    found = initialise(views_of(boards, rng), SIZES)
    # 8 poses x 130 points at 0.05 px; tangential distortion, not estimated, leaves 3e-4 r^2 f < 0.1 px.
    assert worst_reprojection(found, boards, ("C1", "C2", "P1")) < 0.1
    assert found.world_pose == "B00"
    assert found.board_poses["B00"] == Pose(((1, 0, 0), (0, 1, 0), (0, 0, 1)), (0, 0, 0))
    assert found.refused == ()
    for view in found.views:
        assert view.own_rms_px < 1.2 * SIGMA
        assert view.rms_px < 2.0 * SIGMA
    for name, sensor in found.sensors.items():
        true = LENSES[name]
        values = np.array([sensor.intrinsics.fx - true.fx, sensor.intrinsics.cy - true.cy])
        # p1, p2 are left out of the fit and shift the principal point by up to f p = 0.6 px.
        assert np.all(np.abs(values) < 4.0 * sensor.lens_sigma[[0, 3]] + 2.0)


def test_not_every_sensor_need_see_every_pose(rng: np.random.Generator) -> None:
    boards = poses(9, rng)
    seen = {"C1": {0, 1, 2, 3}, "P1": {3, 4, 5, 6}, "C2": {6, 7, 8, 5}}  # C2 is tied to C1 through P1 alone
    views = [v for v in views_of(boards, rng) if int(v.pose[1:]) in seen[v.sensor]]
    found = initialise(views, SIZES)
    assert set(found.board_poses) == {f"B{i:02d}" for i in range(9)}
    # Four poses each: the chain of two shared boards adds a little to what eight poses give.
    assert worst_reprojection(found, boards, ("C1", "C2", "P1")) < 1.0


def test_a_sensor_that_shares_no_pose_is_named(rng: np.random.Generator) -> None:
    boards = poses(6, rng)
    views = [v for v in views_of(boards, rng) if (v.sensor == "P1") == (int(v.pose[1:]) > 2)]
    with pytest.raises(CalibrationFailed, match=r"P1 cannot be placed .* record a pose that both see"):
        initialise(views, SIZES)


def test_the_world_may_be_given(rng: np.random.Generator) -> None:
    boards = poses(5, rng)
    views = views_of(boards, rng)
    plain = initialise(views, SIZES)
    given = Pose.from_arrays(rotation_matrix(np.array([0.1, 0.7, -0.2])), np.array([100.0, -50.0, 20.0]))
    moved = initialise(views, SIZES, board_in_world=given)
    for name in SIZES:
        expected = compose(plain.sensors[name].pose, inverse(given))
        # The same least squares in another frame: they stop within 1e-9 of the cost of the minimum.
        np.testing.assert_allclose(moved.sensors[name].pose.matrix(), expected.matrix(), atol=1e-6)
        np.testing.assert_allclose(moved.sensors[name].pose.translation, expected.translation, atol=1e-3)


def test_one_tilted_pose_is_enough_to_begin(rng: np.random.Generator) -> None:
    centred = {n: Intrinsics(1850.0, 1850.0, 0.5 * (s[0] - 1), 0.5 * (s[1] - 1)) for n, s in SIZES.items()}
    board, points, views = poses(1, rng), grid(), []
    for name in ("C1", "C2"):
        pixel = project(centred[name], RIG[name], transform(board[0], points))
        pixel = pixel + SIGMA * rng.standard_normal(pixel.shape)
        views.append(BoardView(name, "B00", points, pixel, np.full(len(points), SIGMA)))
    found = initialise(views, {n: SIZES[n] for n in ("C1", "C2")})
    for name in ("C1", "C2"):
        sensor = found.sensors[name]
        assert sensor.lens_sigma[0] < 0.02 * 1850.0
        assert abs(sensor.intrinsics.fx - 1850.0) < 4.0 * sensor.lens_sigma[0]  # four standard deviations
        assert "principal point was held in the middle" in sensor.notes[0]


def facing(name: str, distances: tuple[float, ...]) -> list[Pose]:
    """Return boards parallel to the image of a sensor."""
    back = inverse(RIG[name])
    turn = np.eye(3)
    return [compose(back, Pose.from_arrays(turn, np.array([-90.0, -67.5, d]))) for d in distances]


def test_a_board_that_is_never_tilted_is_refused(rng: np.random.Generator) -> None:
    for boards in (facing("C1", (900.0,)), facing("C1", (800.0, 900.0, 1000.0))):
        views = views_of(boards, rng, sensors=("C1",))
        with pytest.raises(
            CalibrationFailed, match=r"focal length of C1 .* tilted by \d\.\d degrees at most"
        ):
            initialise(views, {"C1": SIZES["C1"]})


def test_boards_placed_by_others_help_a_sensor_that_they_face(rng: np.random.Generator) -> None:
    boards = facing("C1", (820.0, 880.0, 940.0, 1000.0))
    views = views_of(boards, rng)
    for seen in ("C2", "P1"):  # from the side the same boards are tilted, though all alike
        assert any(v.sensor == seen for v in views)
    boards += poses(4, rng)
    extra = [v for v in views_of(boards, rng) if v.sensor != "C1" and int(v.pose[1:]) > 3]
    found = initialise(views + extra, SIZES)
    assert "DLT" in found.sensors["C1"].notes[0]
    # Its distance and focal length are told by the distances of the boards alone.
    assert worst_reprojection(found, boards[:4], ("C1",)) < 0.2


def test_wrong_points_and_views_are_refused_with_a_reason(rng: np.random.Generator) -> None:
    boards = poses(7, rng)
    views = views_of(boards, rng)
    wrong = np.arange(0, 130, 13)
    first = views[0].pixel.copy()
    first[wrong] += rng.uniform(5.0, 50.0, (len(wrong), 2))
    views[0] = BoardView("C1", "B00", views[0].point, first, views[0].sigma_px)
    few = views[4].part(np.arange(130) < 5)
    views[4] = few
    line = views[8].part(np.arange(130) < 13)
    views[8] = line
    shuffled = views[12]
    views[12] = BoardView(
        shuffled.sensor, shuffled.pose, rng.permutation(shuffled.point), shuffled.pixel, shuffled.sigma_px
    )
    found = initialise(views, SIZES)
    reasons = {(r.sensor, r.pose): r for r in found.refused}
    assert reasons["C1", "B00"].count == len(wrong)
    assert "fewer than 6" in reasons[few.sensor, few.pose].reason
    assert "on a line" in reasons[line.sensor, line.pose].reason
    assert "agree" in reasons[shuffled.sensor, shuffled.pose].reason
    assert worst_reprojection(found, boards, ("C1", "C2", "P1")) < 0.15  # as without them, from fewer points


def test_no_views_and_double_views_are_refused(rng: np.random.Generator) -> None:
    views = views_of(poses(2, rng), rng)
    with pytest.raises(InvalidInput, match="at least one pose"):
        initialise([], SIZES)
    with pytest.raises(InvalidInput, match="two views of C1"):
        initialise([*views, views[0]], SIZES)
    with pytest.raises(InvalidInput, match="size of the image of P1"):
        initialise(views, {"C1": SIZES["C1"], "C2": SIZES["C2"]})
    with pytest.raises(InvalidInput, match="B77"):
        initialise(views, SIZES, world_pose="B77")
    with pytest.raises(InvalidInput, match="flat"):
        BoardView("C1", "B00", np.ones((8, 3)), np.zeros((8, 2)), np.ones(8))
    with pytest.raises(CalibrationFailed, match="saw no board"):
        initialise([v.part(np.arange(130) < 4) for v in views], SIZES)


def test_refinement_agrees_with_an_independent_program(rng: np.random.Generator) -> None:
    boards = poses(6, rng)
    views = views_of(boards, rng, sensors=("C1",))
    seen = [SeenPoints(v.point, v.pixel, v.sigma_px) for v in views]
    start = [compose(RIG["C1"], b) for b in boards]
    lens = Intrinsics(1800.0, 1800.0, 639.5, 511.5)
    free = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    found = refine_sensor(seen, lens, start, free=free, refuse=False)
    _, k, d, _, _, sigma, _, _ = cv2.calibrateCameraExtended(
        [v.point.astype(np.float32) for v in views],
        [v.pixel.astype(np.float32) for v in views],
        SIZES["C1"],
        np.zeros((3, 3)),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
        criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-12),
    )
    mine = np.array([found.intrinsics.fx, found.intrinsics.fy, found.intrinsics.cx, found.intrinsics.cy])
    theirs = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
    # Both are maximum likelihood but for Huber weights on 1 % of the points: a tenth of a standard deviation
    # each way, and single-precision pixels on their side.
    assert np.all(np.abs(mine - theirs) < 0.3 * found.lens_sigma[:4])
    assert np.all(np.abs(found.intrinsics.distortion()[:4] - d.ravel()[:4]) < 0.3 * found.lens_sigma[4:8])
    # They scale by the residuals, and so do we: equal but for the robust scale, known to 3 %.
    np.testing.assert_allclose(
        found.lens_sigma[:4] * found.scale, sigma.ravel()[:4] / SIGMA * SIGMA, rtol=0.15
    )


def test_an_adjustment_starts_from_first_values(rng: np.random.Generator) -> None:
    boards = poses(8, rng)
    views = views_of(boards, rng)
    first = initialise(views, SIZES)
    found = adjust(board_problem(first, views, projectors=("P1",)))
    assert [s.name for s in found.sensors] == ["C1", "C2", "P1"]
    assert {r.type for r in found.rms} == {"board in camera", "board in projector"}
    for sensor in found.sensors:
        points = np.concatenate([transform(b, grid()) for b in boards])
        off = project(sensor.intrinsics, sensor.pose, transform(inverse(boards[0]), points))
        off -= project(LENSES[sensor.name], RIG[sensor.name], points)
        # 6240 coordinates tell 69 parameters: sigma sqrt(69 / 6240) = 0.005 px, and three times that.
        assert np.sqrt(np.mean(off**2)) < 0.016
