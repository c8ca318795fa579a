"""Published calibration data, solved to the published figures or better."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.board_adjustments import board_problem

from sms_jobs.metrology.calibration.board_views import BoardView
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.calibration.starting.initialisation import InitialCalibration, initialise
from sms_jobs.metrology.calibration.starting.sensor_refinement import RefinedSensor, SeenPoints, refine_sensor
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.geometry.lens import KEPT, Intrinsics
from sms_jobs.metrology.geometry.transforms import compose, transform
from sms_jobs.metrology.targets.boards import find_board
from sms_jobs.metrology.targets.chessboards import find_chessboard
from sms_jobs.records.artefacts import CircleBoard

FOLDER = Path(__file__).resolve().parents[4] / "shared" / "data" / "calibration"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"put the published calibration data into {FOLDER} for these tests"
)

# DICe's simulated board; the dots' diameter is not published and is 0.281 of the pitch in the images.
DOTS = CircleBoard(14, 10, 7.0, 1.97, ((2, 7), (11, 7), (2, 2)))


def grey(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image)


def chessboards(pattern: str, sensor: str, columns: int, rows: int, pitch: float) -> list[BoardView]:
    views = []
    for path in sorted(FOLDER.glob(pattern)):
        found = find_chessboard(grey(path), columns, rows, pitch)
        assert len(found.place) == columns * rows
        views.append(BoardView(sensor, path.stem[-2:], found.point, found.centre_px, found.sigma_px))
    return views


def refined(initial: InitialCalibration, views: list[BoardView], name: str, *free: str) -> RefinedSensor:
    """Fit one sensor to all points of its views, none of them refused, from the first values."""
    own = [v for v in views if v.sensor == name]
    sensor = initial.sensors[name]
    poses = [compose(sensor.pose, initial.board_poses[v.pose]) for v in own]
    # The published figures are of plain least squares that weighs all points alike.
    seen = [SeenPoints(v.point, v.pixel, np.ones(len(v.pixel))) for v in own]
    free = ("fx", "fy", "cx", "cy", *free)
    return refine_sensor(seen, sensor.intrinsics, poses, free=free, huber=np.inf, refuse=False)


def rms(residuals: list[NDArray[np.float64]] | tuple[NDArray[np.float64], ...]) -> float:
    """Return the rms length of residuals (n, 2) in px, as OpenCV and the publishers state it."""
    return float(np.sqrt(np.mean(np.sum(np.concatenate(residuals) ** 2, axis=1))))


def together(initial: InitialCalibration, views: list[BoardView]) -> float:
    """Return the rms length over all sensors in one world, of all points of the usable views."""
    residuals = []
    for view in views:
        if view.pose in initial.board_poses:
            sensor = initial.sensors[view.sensor]
            points = transform(initial.board_poses[view.pose], view.point)
            residuals.append(view.pixel - project(sensor.intrinsics, sensor.pose, points))
    return rms(residuals)


def plainly_adjusted(
    initial: InitialCalibration,
    views: list[BoardView],
    projectors: tuple[str, ...] = (),
    fixed: tuple[str, ...] = KEPT,
) -> Adjustment:
    """Adjust all sensors together by plain least squares, no point refused, the board taken as exact."""
    alike = [BoardView(v.sensor, v.pose, v.point, v.pixel, np.full(len(v.pixel), 0.1)) for v in views]
    problem = board_problem(initial, alike, projectors, fixed)
    return adjust(problem, BundleOptions(huber=np.inf, reject=np.inf))


def opencv(views: list[BoardView], size: tuple[int, int], flags: int) -> tuple[float, Intrinsics]:
    found = cv2.calibrateCamera(
        [v.point.astype(np.float32) for v in views],
        [v.pixel.astype(np.float32) for v in views],
        size,
        np.eye(3),
        np.zeros(5),
        flags=flags,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-12),
    )
    k, d = found[1], found[2].ravel()
    return found[0], Intrinsics(k[0, 0], k[1, 1], k[0, 2], k[1, 2], *map(float, d[:5]))


def test_a_projector_is_found_as_a_camera_is() -> None:
    published = np.load(FOLDER / "procam" / "procam_correspondences.npz")
    views, sizes = [], {"C1": (1280, 960), "P1": (1024, 768)}
    for i in range(5):
        for name, key in (("C1", "cam"), ("P1", "proj")):
            point = published[f"obj{i}"].astype(float)
            pixel = published[f"{key}{i}"].reshape(-1, 2).astype(float)
            views.append(BoardView(name, f"B{i}", point, pixel, np.full(len(point), 0.15)))
    initial = initialise(views, sizes)
    # The projector's principal point is far below the middle of its image, as projectors are built.
    assert initial.sensors["P1"].intrinsics.cy > 768
    # Published: 0.32, 0.35 and 0.58 px; measured here with all points: 0.319, 0.204 and 0.272.
    for name, limit in (("C1", 0.325), ("P1", 0.25)):
        found = refined(initial, views, name, "k1", "k2", "p1", "p2")
        assert rms(found.residual) < limit
        own = [v for v in views if v.sensor == name]
        theirs, lens = opencv(own, sizes[name], cv2.CALIB_FIX_K3)
        # The same least squares, but for the weak prior on distortion: a part in a thousand.
        assert rms(found.residual) == pytest.approx(theirs, rel=2e-3)
        # Five poses leave the focal length open to 0.5 %, and k2 of this narrow lens to 1, as the prior.
        assert found.intrinsics.fx == pytest.approx(lens.fx, rel=5e-3)
    adjusted = plainly_adjusted(initial, views, projectors=("P1",))
    assert rms(adjusted.residual_board) < 0.3


def test_a_real_camera_from_chessboards() -> None:
    views, size = chessboards("chess/frame*.jpg", "C1", 4, 6, 30.0), (640, 480)
    initial = initialise(views, {"C1": size})
    found = refined(initial, views, "C1", "k1", "k2")
    # Published: 0.154 px, fx = 701.0, fy = 698.7; OpenCV from our corners: 0.143 px, 702.6.
    assert rms(found.residual) < 0.154
    theirs, lens = opencv(views, size, cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST)
    assert rms(found.residual) == pytest.approx(theirs, rel=2e-3)  # as above
    for mine, other, published in (
        (found.intrinsics.fx, lens.fx, 701.0),
        (found.intrinsics.fy, lens.fy, 698.7),
    ):
        assert mine == pytest.approx(other, abs=1.0)  # three standard deviations
        assert mine == pytest.approx(published, abs=3.0)  # other corners: the same and theirs


def test_real_chessboards_in_stereo_start_as_well_as_published() -> None:
    views = chessboards("chessboard_stereo/left*.jpg", "C1", 9, 6, 25.0)
    views += chessboards("chessboard_stereo/right*.jpg", "C2", 9, 6, 25.0)
    initial = initialise(views, {"C1": (640, 480), "C2": (640, 480)})
    assert len(initial.board_poses) == 13
    # Published: left 0.25 px, stereo 0.27 px.
    assert rms(refined(initial, views, "C1", "k1", "k2", "p1", "p2").residual) < 0.18
    assert together(initial, views) < 0.27
    # All are free: corners of the box about these poses, which no camera sees, are uncertain by 1/300 of its
    # diagonal, which would be refused; what both cameras see of it, by 1/1800.
    adjusted = plainly_adjusted(initial, views)
    assert rms(adjusted.residual_board) < 0.19
    diagonal = 462.0
    assert diagonal / 5000 < adjusted.shape_sigma_mm < diagonal / 1000


@pytest.mark.long  # 20 s
def test_simulated_dots_in_stereo_start_as_well_as_published() -> None:
    views = []
    for path in sorted(FOLDER.glob("dots_stereo/*.jpeg")):
        found = find_board(grey(path), DOTS)
        sensor = "C1" if path.stem.endswith("_0") else "C2"
        views.append(BoardView(sensor, path.stem[4:6], found.point, found.centre_px, found.sigma_px))
    assert len(views) == 42
    initial = initialise(views, {"C1": (1920, 1200), "C2": (1920, 1200)})
    # Wanted: 0.02 px in stereo; before any bundle adjustment 0.007 px is measured here.
    assert together(initial, views) < 0.01
    assert len(initial.board_poses) == 21
    adjusted = plainly_adjusted(initial, views)
    assert rms(adjusted.residual_board) < 0.008
    # What the start says of a sensor, the adjustment finds: within five of the start's standard deviations.
    for sensor in adjusted.sensors:
        first = initial.sensors[sensor.name]
        assert abs(sensor.intrinsics.fx - first.intrinsics.fx) < 5.0 * first.lens_sigma[0]
