"""Dots and rings: centres, shapes, their standard deviations, and the perspective of a circle's centre."""

from __future__ import annotations

from math import pi
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr

from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.targets.circles import find_circles, semi_axes
from sms_jobs.metrology.targets.ellipse_fit import FITTED, fit_ellipses
from sms_jobs.metrology.targets.patterns import BoardPattern
from sms_jobs.metrology.targets.perspective import (
    centre_bias,
    centre_bias_of_camera,
    centre_bias_of_view,
    fit_plane_view,
    through_homography,
)

Floats = NDArray[np.float64]
BOARD = BoardPattern(9, 7, 10.0, 5.0, ((2, 5), (6, 5), (2, 1)), "ring", 5.0, 2.0)
# A strong lens and a strong tilt: the bias is a tenth of a pixel.
HOMOGRAPHY = np.array([[3.9, -1.0, 120.0], [1.2, 3.5, 60.0], [5e-4, 8e-4, 1.0]])
NOISE = 4.0


def every_place(board: BoardPattern) -> Floats:
    row, column = np.indices((board.rows, board.columns))
    return np.column_stack([column.ravel(), row.ravel()]) * board.pitch_mm


def matched(found: Floats, wanted: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return the nearest wanted point of each that was found, and the way to it (n, 2)."""
    way = found[:, None, :] - wanted[None, :, :]
    nearest = np.argmin(np.hypot(way[..., 0], way[..., 1]), axis=1)
    return nearest, way[np.arange(len(found)), nearest]


@pytest.mark.parametrize(("blur", "slope"), [(0.5, (0.0, 0.0)), (0.9, (0.5, -0.4)), (1.5, (0.0, 0.3))])
def test_centres_are_those_of_the_ellipses(draughtsman: Any, blur: float, slope: tuple[float, float]) -> None:
    plain = BoardPattern(9, 7, 10.0, 5.0)
    view = draughtsman.view_of(300, 400, (40.0, 30.0), 3.2, turn=0.3, tilt=(0.5, 0.3))
    image = draughtsman.draw(view, draughtsman.dots(plain), blur=blur, slope=slope)
    found = find_circles(image)
    assert len(found.centre) == 63
    assert not found.ring.any()
    centres = every_place(plain)
    ellipse = view.image(centres) + centre_bias(view.homography, centres, np.full(63, 5.0))
    nearest, way = matched(found.centre, ellipse)
    assert len(set(nearest.tolist())) == 63
    # Without noise what is left is the model's: square pixels, light times an edge, 1e-3 of a blur.
    assert np.abs(way).max() < 2e-3
    # A pixel's box adds 1/12 to the variance of the edge.
    assert np.median(found.blur) == pytest.approx(np.hypot(blur, np.sqrt(1 / 12)), rel=0.02)


def test_shape_and_contrast_are_measured(draughtsman: Any) -> None:
    view = draughtsman.view_of(160, 200, (40.0, 30.0), 4.0, turn=0.4, tilt=(0.0, 0.8), focal=1e5)
    one = BoardPattern(9, 7, 10.0, 6.0)
    found = find_circles(draughtsman.draw(view, draughtsman.dots(one), dark=30.0, bright=180.0))
    axes, angle = found.axes()
    # Far away: a circle of 12 px radius, shortened across the tilted axis, which is the image's x.
    # Curved edges are drawn inwards by blur^2 / 2 radius, 0.03 px.
    np.testing.assert_allclose(axes[:, 0], 12.0, atol=0.05)
    np.testing.assert_allclose(axes[:, 1], 12.0 * np.cos(0.8), atol=0.05)
    np.testing.assert_allclose(np.abs(np.abs(angle) - pi / 2), 0.0, atol=0.01)
    np.testing.assert_allclose(found.contrast(), -150.0, rtol=0.01)


def test_predicted_scatter_is_the_scatter(draughtsman: Any, rng: np.random.Generator) -> None:
    plain = BoardPattern(9, 7, 10.0, 5.0)
    view = draughtsman.view_of(300, 400, (40.0, 30.0), 3.2, turn=0.3, tilt=(0.5, 0.3))
    image = draughtsman.draw(view, draughtsman.dots(plain))
    centres = every_place(plain)
    ellipse = view.image(centres) + centre_bias(view.homography, centres, np.full(63, 5.0))
    scores = []
    for _ in range(6):
        found = find_circles(image + rng.normal(0.0, NOISE, image.shape))
        _, way = matched(found.centre, ellipse)
        root = np.linalg.cholesky(found.covariance)
        scores.append(np.linalg.solve(root, way[:, :, None]).ravel())
    z = np.concatenate(scores)
    assert len(z) > 700
    # The root mean square of 750 normal numbers scatters by 1 / sqrt(2 x 750) = 2.6 %; four of those.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.105)


def test_the_kernel_finds_the_least_squares(rng: np.random.Generator) -> None:
    centre, a, b, turn, blur = np.array([31.3, 32.2]), 10.0, 7.5, 0.4, 0.9
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    matrix = rotation @ np.diag([1 / a, 1 / b]) @ rotation.T
    y, x = np.mgrid[0:64, 0:64].astype(np.float64)

    def model(p: Floats) -> tuple[Floats, Floats]:
        q = np.stack([x - p[0], y - p[1]], axis=-1) @ np.array([[p[2], p[3]], [p[3], p[4]]])
        size = np.hypot(q[..., 0], q[..., 1])
        g = q @ np.array([[p[2], p[3]], [p[3], p[4]]]) / size[..., None]
        d = (size - 1.0) / np.hypot(g[..., 0], g[..., 1])
        u, v = x - centre[0], y - centre[1]
        ground, ink = p[6] + p[7] * u + p[8] * v, p[9] + p[10] * u + p[11] * v
        return ground + (ink - ground) * ndtr(-d / p[5]), d

    truth = np.array(
        [*centre, matrix[0, 0], matrix[0, 1], matrix[1, 1], blur, 200.0, 0.5, -0.3, 40.0, 0.1, 0.0]
    )
    image = (model(truth)[0] + rng.normal(0.0, NOISE, x.shape)).astype(np.float32)
    fit = fit_ellipses(image, centre[None] + 0.4, matrix[None] * 1.03, np.array([9.0]), np.array([12.0]))
    assert fit.status[0] == FITTED
    band = np.abs(model(truth)[1]) < 3.0
    slow = least_squares(lambda p: (model(p)[0] - image)[band], truth, x_scale=np.abs(truth) + 0.01)
    # The pixels differ by those that the found ellipse has and the true one has not in the band of 3 px,
    # a few of 300, where the edge's profile has ended.
    np.testing.assert_allclose(fit.centre[0], slow.x[:2], atol=2e-3)
    spread = np.linalg.inv(slow.jac.T @ slow.jac)[:2, :2] * NOISE**2
    # The variance of 300 residuals is known to sqrt(2 / 300) = 8 %, and three of those.
    np.testing.assert_allclose(np.diag(fit.covariance[0]), np.diag(spread), rtol=0.25)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
def test_types_of_images_do_not_matter(draughtsman: Any, kind: str) -> None:
    view = draughtsman.view_of(200, 240, (40.0, 30.0), 2.4)
    image = draughtsman.draw(view, draughtsman.dots(BOARD))
    scale = 256.0 if kind == "uint16" else 1.0
    found = find_circles(np.rint(image * scale).astype(kind))
    _, way = matched(found.centre, view.image(every_place(BOARD)))
    assert len(found.centre) == 63
    # Rounding to whole grey levels is noise of 0.3 of 160 levels: below a hundredth of a pixel.
    assert np.abs(way).max() < 0.01


def test_bright_ink_is_found_as_dark_ink_is(draughtsman: Any) -> None:
    view = draughtsman.view_of(200, 240, (40.0, 30.0), 2.4, turn=0.2)
    image = draughtsman.draw(view, draughtsman.dots(BOARD))
    dark, bright = find_circles(image), find_circles(240.0 - image, ink="bright")
    nearest, way = matched(bright.centre, dark.centre)
    assert len(nearest) == 63
    # Nothing differs but a sign: rounding of single precision.
    assert np.abs(way).max() < 1e-4
    assert bright.contrast().min() > 0.0
    assert dark.contrast().max() < 0.0


def test_rings_have_two_ellipses(draughtsman: Any) -> None:
    view = draughtsman.view_of(300, 400, (40.0, 30.0), 3.6, turn=0.2, tilt=(0.3, 0.2))
    found = find_circles(draughtsman.draw(view, draughtsman.dots(BOARD)))
    markers = np.array(BOARD.markers) * BOARD.pitch_mm
    assert int(found.ring.sum()) == 3
    for centre, diameter in ((found.centre, 5.0), (found.hole_centre, 2.0)):
        wanted = view.image(markers) + centre_bias(view.homography, markers, np.full(3, diameter))
        _, way = matched(centre[found.ring], wanted)
        assert np.abs(way).max() < 0.01  # the wall is 5 px, and the two edges' blurs just touch
    outer = np.sqrt(np.prod(semi_axes(found.matrix[found.ring])[0], axis=1))
    inner = np.sqrt(np.prod(semi_axes(found.hole_matrix[found.ring])[0], axis=1))
    # Edges of small holes move by blur^2 / 2 radius, 0.08 px of 3.6.
    np.testing.assert_allclose(inner / outer, 0.4, rtol=0.04)
    assert np.isnan(found.hole_centre[~found.ring]).all()


def test_what_is_no_dot_is_refused_and_counted(rng: np.random.Generator) -> None:
    image = np.full((200, 300), 180.0)
    cv2.rectangle(image, (20, 20), (44, 44), 40.0, -1)
    cv2.fillPoly(image, [np.array([[90, 20], [120, 60], [70, 50]])], 40.0)
    cv2.circle(image, (200, 40), 14, 40.0, -1)
    cv2.rectangle(image, (200, 20), (230, 60), 180.0, -1)  # hides half of the dot
    cv2.circle(image, (297, 120), 12, 40.0, -1)  # cut by the border
    cv2.circle(image, (150, 140), 12, 40.0, -1)
    image = cv2.GaussianBlur(image, (0, 0), 0.8) + rng.normal(0.0, 2.0, image.shape)
    found = find_circles(image)
    np.testing.assert_allclose(found.centre, [[150.0, 140.0]], atol=0.1)
    assert found.refused["no ellipse"] > 0
    assert found.refused["at the border of the image"] > 0


def test_an_empty_image_has_no_dots(rng: np.random.Generator) -> None:
    assert len(find_circles(np.zeros((60, 80), np.uint8)).centre) == 0
    assert len(find_circles(rng.normal(100.0, 3.0, (120, 160))).centre) == 0


def test_threads_change_nothing(draughtsman: Any) -> None:
    view = draughtsman.view_of(200, 240, (40.0, 30.0), 2.4, turn=0.2)
    image = draughtsman.draw(view, draughtsman.dots(BOARD))
    one, two = find_circles(image), find_circles(image, threads=2)
    np.testing.assert_array_equal(one.centre, two.centre)
    np.testing.assert_array_equal(one.covariance, two.covariance)


def ellipse_centre(points: Floats) -> Floats:
    """Return the centre of the conic through points (n, 2)."""
    middle, size = points.mean(axis=0), np.abs(points - points.mean(axis=0)).max()
    x, y = ((points - middle) / size).T
    a, b, c, d, e = np.linalg.lstsq(np.stack([x * x, x * y, y * y, x, y], -1), np.ones_like(x))[0]
    return np.asarray(middle - size * np.linalg.solve([[2 * a, b], [b, 2 * c]], [d, e]))


def edge_of(centre: Floats, diameter: float) -> Floats:
    turn = np.linspace(0.0, 2.0 * pi, 60, endpoint=False)
    return np.asarray(centre + 0.5 * diameter * np.stack([np.cos(turn), np.sin(turn)], axis=-1))


def test_the_perspective_of_a_centre_is_exact() -> None:
    centres = np.array([[0.0, 0.0], [80.0, 10.0], [40.0, 60.0]])
    diameters = np.array([5.0, 12.0, 8.0])
    bias = centre_bias(HOMOGRAPHY, centres, diameters)
    for centre, diameter, got in zip(centres, diameters, bias, strict=True):
        drawn = ellipse_centre(through_homography(HOMOGRAPHY, edge_of(centre, diameter)))
        # Both are exact: a circle's image under a homography is an ellipse.
        np.testing.assert_allclose(got, drawn - through_homography(HOMOGRAPHY, centre[None])[0], atol=1e-9)
    assert np.hypot(*bias.T).max() > 0.05


def test_the_lens_has_its_share_of_the_bias(draughtsman: Any) -> None:
    view = draughtsman.view_of(400, 500, (40.0, 30.0), 3.5, turn=2.0, tilt=(0.5, -0.3), k1=-0.25)
    centres = every_place(BOARD)
    bias = np.array([ellipse_centre(view.image(edge_of(c, 5.0))) for c in centres]) - view.image(centres)
    fitted = fit_plane_view(centres, view.image(centres))
    got = centre_bias_of_view(fitted, centres, np.full(len(centres), 5.0))
    straight = centre_bias(view.homography, centres, np.full(len(centres), 5.0))
    # The bend of a wide lens is a polynomial to a few thousandths of a pixel at the image's corners, and the
    # terms of fourth order are r^2 / f^2 of those of second, 3e-4.
    assert np.abs(got - bias).max() < 5e-3
    assert np.abs(straight - bias).max() > 0.03


def test_a_calibrated_camera_knows_the_bias() -> None:
    camera = Intrinsics(600.0, 610.0, 250.0, 200.0, -0.25, 0.1, 1e-3, -2e-3, 0.0)
    turn = cv2.Rodrigues(np.array([0.5, -0.3, 0.2]))[0]
    pose = Pose.from_arrays(turn, np.array([-30.0, -25.0, 160.0]))
    points = np.column_stack([every_place(BOARD), np.zeros(63)])
    got = centre_bias_of_camera(camera, pose, points, np.full(63, 5.0))
    for point, bias in zip(points[::7], got[::7], strict=True):
        edge = np.column_stack([edge_of(point[:2], 5.0), np.zeros(60)])
        wanted = ellipse_centre(project(camera, pose, edge)) - project(camera, pose, point[None])[0]
        # 24 points and 60 fit the same ellipse but for the lens's third order, r^3 f'' / f ~ 1e-4 px.
        np.testing.assert_allclose(bias, wanted, atol=1e-5)
    # Without distortion the pole of the line at infinity is the same thing.
    ideal = Intrinsics(600.0, 610.0, 250.0, 200.0)
    homography = ideal.matrix() @ np.column_stack([turn[:, :2], pose.translation])
    np.testing.assert_allclose(
        centre_bias_of_camera(ideal, pose, points, np.full(63, 5.0)),
        centre_bias(homography, points[:, :2], np.full(63, 5.0)),
        atol=1e-9,
    )
