"""Homographies and the direct linear transform."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.calibration.starting.direct_linear_transform import direct_linear_transform
from sms_jobs.metrology.calibration.starting.homography import (
    apply_homography,
    fit_homography,
    flatness,
    normalising,
)
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics

Floats = NDArray[np.float64]

LENS = Intrinsics(1400.0, 1380.0, 660.0, 470.0)
POSE = Pose.looking_at(
    np.array([150.0, -200.0, -600.0]), np.array([40.0, 30.0, 0.0]), np.array([0.0, -1.0, 0.0])
)


def board(columns: int = 10, rows: int = 8, pitch: float = 12.0) -> Floats:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) * pitch


def test_a_homography_of_exact_points_is_exact() -> None:
    points = board()
    pixels = project(LENS, POSE, points)
    fit = fit_homography(points[:, :2], pixels)
    # A pin-hole without distortion images a plane by a homography; rounding of pixels near 1000 is 1e-13.
    np.testing.assert_allclose(apply_homography(fit.matrix, points[:, :2]), pixels, atol=1e-9)
    assert fit.kept.all()
    columns = LENS.matrix() @ np.column_stack([POSE.matrix()[:, :2], POSE.translation])
    np.testing.assert_allclose(fit.matrix / fit.matrix[2, 2], columns / columns[2, 2], rtol=1e-9)


def test_residuals_scatter_as_the_noise(rng: np.random.Generator) -> None:
    points, sigma = board(), 0.05
    pixels = project(LENS, POSE, points)
    squares = []
    for _ in range(100):
        fit = fit_homography(points[:, :2], pixels + sigma * rng.standard_normal(pixels.shape))
        squares.append(fit.rms_px**2)
    # 160 coordinates, 8 parameters: the mean square is sigma^2 (1 - 8 / 160); of 100 runs it is known to
    # sqrt(2 / 15200) = 1.1 %, and 4 of these are 4.6 %.
    assert np.mean(squares) == pytest.approx(sigma**2 * 152 / 160, rel=0.046)


def test_wrong_points_are_refused_and_change_nothing(rng: np.random.Generator) -> None:
    points = board()
    clean = project(LENS, POSE, points) + 0.02 * rng.standard_normal((len(points), 2))
    wrong = rng.choice(len(points), 24, replace=False)  # 30 %
    pixels = clean.copy()
    pixels[wrong] += rng.uniform(20.0, 200.0, (24, 2))
    fit = fit_homography(points[:, :2], pixels)
    assert not fit.kept[wrong].any()
    assert np.delete(fit.kept, wrong).all()  # 8 robust deviations: none of 56 good points is lost
    without = fit_homography(np.delete(points[:, :2], wrong, axis=0), np.delete(clean, wrong, axis=0))
    # The same points, but normalised by others: the reweighted fit stops a little elsewhere, by a fiftieth of
    # what the noise does to it.
    images = [apply_homography(f.matrix, points[:, :2]) for f in (fit, without)]
    np.testing.assert_allclose(*images, atol=4e-4)


def test_less_certain_points_pull_less(rng: np.random.Generator) -> None:
    points = board()
    exact = project(LENS, POSE, points)
    sigma = np.where(np.arange(len(points)) % 2, 0.02, 1.0)
    weighted, equal = [], []
    for _ in range(20):
        pixels = exact + sigma[:, None] * rng.standard_normal(exact.shape)
        for found, stated in ((weighted, sigma), (equal, None)):
            fit = fit_homography(points[:, :2], pixels, stated)
            found.append(np.mean((apply_homography(fit.matrix, points[:, :2]) - exact) ** 2))
    # Half of the points are 50 times better: with weights they alone decide.
    assert np.mean(weighted) < 0.02 * np.mean(equal)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (board(3, 1), "too few"),
        (board(8, 1), "on a line in the board"),
    ],
)
def test_points_that_tell_no_plane_are_refused(points: Floats, words: str) -> None:
    with pytest.raises(CalibrationFailed, match=words):
        fit_homography(points[:, :2], project(LENS, POSE, points))


def test_arrays_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InvalidInput, match="do not belong together"):
        fit_homography(board()[:, :2], np.zeros((3, 2)))
    with pytest.raises(InvalidInput, match="finite"):
        fit_homography(board()[:, :2], np.full((80, 2), np.nan))


def test_normalised_points_have_mean_zero_and_unit_spread(rng: np.random.Generator) -> None:
    points = rng.uniform(-5.0, 900.0, (50, 3))
    t = normalising(points)
    moved = points @ t[:3, :3].T + t[:3, 3]
    np.testing.assert_allclose(moved.mean(axis=0), 0.0, atol=1e-12)
    assert np.mean(np.sum(moved**2, axis=1)) == pytest.approx(3.0)
    assert flatness(board()) == 0.0


def box() -> Floats:
    """Return two boards at an angle: points in space."""
    flat = board()
    turned = flat[:, [0, 2, 1]] * [1.0, 1.0, 0.6]
    return np.concatenate([flat, turned])


def test_a_dlt_of_exact_points_finds_the_sensor() -> None:
    points = box()
    intrinsics, pose = direct_linear_transform(points, project(LENS, POSE, points))
    # Rounding, magnified by the condition of the equations of about 1e4.
    found = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy]
    np.testing.assert_allclose(found, [1400.0, 1380.0, 660.0, 470.0], rtol=1e-8)
    np.testing.assert_allclose(pose.matrix(), POSE.matrix(), atol=1e-9)
    np.testing.assert_allclose(pose.translation, POSE.translation, rtol=1e-8)


def test_a_dlt_does_not_depend_on_the_frame(rng: np.random.Generator) -> None:
    points, shift = box(), np.array([5e3, -2e3, 1e3])
    pixels = project(LENS, POSE, points) + 0.1 * rng.standard_normal((len(points), 2))
    here, there = direct_linear_transform(points, pixels), direct_linear_transform(points + shift, pixels)
    assert here[0].fx == pytest.approx(there[0].fx, rel=1e-8)  # rounding of coordinates 50 times as large
    np.testing.assert_allclose(here[1].centre() + shift, there[1].centre(), atol=1e-4)


def test_a_dlt_refuses_a_plane_and_a_mirror() -> None:
    points = board()
    with pytest.raises(CalibrationFailed, match="on a plane"):
        direct_linear_transform(points, project(LENS, POSE, points))
    with pytest.raises(CalibrationFailed, match="too few"):
        direct_linear_transform(box()[:5], project(LENS, POSE, box()[:5]))
    with pytest.raises(CalibrationFailed, match="mirrored"):
        direct_linear_transform(box(), project(LENS, POSE, box()) * [-1.0, 1.0])
