"""Chessboards: order, corners to a hundredth of a pixel, and their standard deviations."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.targets.chessboards import find_chessboard

NOISE = 4.0
ODD = (8, 5)
EVEN = (6, 4)


def drawn(
    draughtsman: Any, size: tuple[int, int], turn: float, **view: Any
) -> tuple[Any, NDArray[np.float64]]:
    middle = (5.0 * (size[0] - 1), 5.0 * (size[1] - 1))
    seen = draughtsman.view_of(300, 340, middle, 2.6, turn=turn, tilt=(0.4, -0.3), **view)
    return seen, draughtsman.draw(seen, draughtsman.squares(*size, 10.0), slope=(0.4, 0.2))


@pytest.mark.parametrize("turn", [0.0, 0.8, pi / 2, 2.6, -2.0])
def test_a_board_whose_colours_tell_is_the_same_from_every_side(
    draughtsman: Any, rng: np.random.Generator, turn: float
) -> None:
    view, image = drawn(draughtsman, ODD, turn, k1=-0.1)
    found = find_chessboard(image + rng.normal(0.0, NOISE, image.shape), *ODD, 10.0)
    assert len(found.place) == 40
    np.testing.assert_array_equal(found.point[:, :2], found.place * 10.0)
    z = (found.centre_px - view.image(found.point[:, :2])) / found.sigma_px[:, None]
    # 80 normal numbers: 1 / sqrt(160) = 8 %, three of those, and covariances that are not round. A corner by
    # another's name would be 26 px off.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.3)


def test_predicted_scatter_is_the_scatter(draughtsman: Any, rng: np.random.Generator) -> None:
    view, image = drawn(draughtsman, ODD, 0.3)
    scores = []
    for _ in range(6):
        found = find_chessboard(image + rng.normal(0.0, NOISE, image.shape), *ODD, 10.0)
        error = found.centre_px - view.image(found.point[:, :2])
        scores.append(np.linalg.solve(np.linalg.cholesky(found.covariance_px), error[:, :, None]).ravel())
    z = np.concatenate(scores)
    # 480 normal numbers: 1 / sqrt(960) = 3.2 %, four of those.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.13)


def test_corners_are_where_they_are(draughtsman: Any) -> None:
    view, image = drawn(draughtsman, ODD, 0.3)
    found = find_chessboard(image, *ODD, 10.0)
    # Blurred edges cross exactly there; what is left is that pixels are square, 1e-2 of the blur.
    assert np.abs(found.centre_px - view.image(found.point[:, :2])).max() < 0.01


@pytest.mark.parametrize(("turn", "runs_right"), [(0.3, True), (0.3 + pi, False)])
def test_a_board_that_looks_the_same_upside_down_is_taken_as_it_lies(
    draughtsman: Any, turn: float, runs_right: bool
) -> None:
    view, image = drawn(draughtsman, EVEN, turn)
    found = find_chessboard(image, *EVEN, 10.0)
    assert len(found.place) == 24
    last = np.array([EVEN[0] - 1, EVEN[1] - 1])
    place = found.place if runs_right else last - found.place
    assert np.abs(found.centre_px - view.image(place * 10.0)).max() < 0.01
    first, second = (found.centre_px[found.place.tolist().index(p)] for p in ([0, 0], [5, 0]))
    assert second[0] > first[0]


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_types_of_images_do_not_matter(draughtsman: Any, kind: str) -> None:
    view, image = drawn(draughtsman, ODD, 0.1)
    scale = 200.0 if kind == "uint16" else 1.0
    found = find_chessboard(np.rint(image * scale).astype(kind), *ODD, 10.0)
    # Rounding is noise of 0.3 of 160 levels.
    assert np.abs(found.centre_px - view.image(found.point[:, :2])).max() < 0.02


def test_edges_along_pixel_rows_are_no_trouble() -> None:
    # Sharp edges between pixels: a point's model has no blur small enough, and must settle all the same.
    y, x = np.mgrid[0:160, 0:200]
    inside = (x >= 20) & (x < 180) & (y >= 20) & (y < 140)
    image = np.where(inside & ((x // 20 + y // 20) % 2 == 0), 40, 200).astype(np.uint8)
    found = find_chessboard(image, 7, 5, 10.0)
    assert len(found.place) == 35
    # Corners are at the corners of four pixels, and everything about them is symmetric.
    assert np.abs(found.centre_px % 1.0 - 0.5).max() < 0.01


def test_no_chessboard_is_no_chessboard(draughtsman: Any) -> None:
    _, image = drawn(draughtsman, ODD, 0.3)
    for other in (image[:, :150], np.zeros((120, 160), np.uint8)):
        found = find_chessboard(other, *ODD, 10.0)
        assert len(found.place) == 0
        assert "8 by 5 inner corners" in found.reason


@pytest.mark.parametrize("told", [(7, 5), (8, 4), (7, 4), (6, 3), (3, 3)], ids=str)
@pytest.mark.parametrize("turn", [0.0, 0.8, 2.6])
def test_a_part_of_a_larger_board_is_not_numbered(
    draughtsman: Any, told: tuple[int, int], turn: float
) -> None:
    _, image = drawn(draughtsman, ODD, turn)
    found = find_chessboard(image, *told, 10.0)
    # One row or column less can be any of two parts of the board: points that are wrong by 10 mm.
    assert len(found.place) == 0
    assert f"{told[0]} by {told[1]} inner corners" in found.reason
    assert "correct the number of corners" in found.reason
