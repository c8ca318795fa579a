"""What a camera blurs does not stretch with the specimen: by that the images of two views differ."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.deformation.matching.camera_matching import _taken_for_a_shift
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.spots import measured_spots
from sms_jobs.metrology.deformation.matching.verification import verify_displacement

SIZE, BLUR, RADIUS = 120, 0.44, 12


def spots(across: NDArray[np.float64], blur: float) -> NDArray[np.float64]:
    """Return an image (SIZE, SIZE) of Gaussian spots that are moved by x' = across x, and then blurred."""
    rng = np.random.default_rng(5)
    count, spread = 1200, 1.2**2
    centre = rng.uniform(-15.0, SIZE + 15.0, (count, 2)) - SIZE / 2.0
    height = rng.uniform(20.0, 60.0, count)
    covariance = spread * across @ across.T + blur * np.eye(2)
    # A spot keeps its light: what is stretched is as bright as before, what is blurred less.
    height = height * np.sqrt(np.linalg.det(spread * across @ across.T) / np.linalg.det(covariance))
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    weight, image = np.linalg.inv(covariance), np.zeros((SIZE, SIZE))
    for (cx, cy), h in zip(centre @ across.T + SIZE / 2.0, height, strict=True):
        dx, dy = x - cx, y - cy
        image += h * np.exp(-0.5 * (weight[0, 0] * dx**2 + 2 * weight[0, 1] * dx * dy + weight[1, 1] * dy**2))
    return image


@pytest.mark.parametrize(
    "across", [np.diag([0.75, 1.0]), np.diag([1.3, 1.0]), np.array([[0.85, 0.1], [0.0, 1.0]])]
)
def test_a_view_that_is_foreshortened_leaves_nothing_over_but_its_fourth_derivatives(
    across: NDArray[np.float64],
) -> None:
    """Left over of a wave k is exp(-b k^2 D / 2) less its first term: a few times less than the whole."""
    reference, deformed = spots(np.eye(2), BLUR), spots(across, BLUR)
    labels = np.ones(reference.shape, np.int32)
    x, y = (values.ravel() for values in np.meshgrid(np.arange(40, 81, 8), np.arange(40, 81, 8)))
    slopes = across - np.eye(2)
    shift = np.stack([x - SIZE / 2.0, y - SIZE / 2.0], axis=1) @ slopes.T
    guess = np.zeros((len(x), 6))
    guess[:, [0, 3]] = shift + 0.2
    guess[:, [1, 2, 4, 5]] = slopes.ravel()
    found = {
        blur: match_points(
            prepare_images(reference, deformed, labels, spots=(blur, blur)),
            x,
            y,
            guess,
            MatchSettings(RADIUS),
        )
        for blur in (0.0, BLUR)
    }
    assert all((one.ending == CONVERGED).all() for one in found.values())
    error = {blur: np.hypot(*(one.warp[:, [0, 3]] - shift).T) for blur, one in found.items()}
    stated = {blur: np.hypot(*one.sigma.T) for blur, one in found.items()}
    assert np.median(stated[BLUR]) < 0.5 * np.median(stated[0.0])
    assert np.sqrt(np.mean(error[BLUR] ** 2)) < 0.5 * np.sqrt(np.mean(error[0.0] ** 2))


def test_a_displacement_is_held_against_images_that_are_blurred_alike() -> None:
    """What two views show differently for their blur alone is no reason to doubt a displacement."""
    across = np.diag([0.75, 1.0])
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2.0
    exact = np.stack([-0.25 * x, 0.0 * y])
    bias = []
    for blur in (0.0, BLUR):
        images = prepare_images(
            spots(np.eye(2), BLUR), spots(across, BLUR), np.ones((SIZE, SIZE), np.int32), spots=(blur, blur)
        )
        bias.append(verify_displacement(images, exact, RADIUS, 2, 0.0).bias[0, 30:-30, 30:-30].mean())
    assert bias[1] < 0.25 * bias[0]


def test_what_first_order_takes_for_a_shift_on_the_way_back() -> None:
    """Against a plane fitted to the exact inverse over the square, to the next order in curvature."""
    warp = np.array([[0.4, 0.2, -0.1, -0.3, 0.05, -0.15, 8e-4, -5e-4, 3e-4, -4e-4, 6e-4, 2e-4]])
    slopes = np.eye(2) + warp[0, [1, 2, 4, 5]].reshape(2, 2)
    bend = np.array([warp[0, 6:9], warp[0, 9:12]])
    j, i = (values.ravel().astype(float) for values in np.mgrid[-8:9, -8:9])
    there = np.stack([i, j])
    home = np.linalg.solve(slopes, there)
    for _ in range(50):
        curved = (
            0.5 * bend[:, :1] * home[0] ** 2
            + bend[:, 1:2] * home[0] * home[1]
            + 0.5 * bend[:, 2:] * home[1] ** 2
        )
        home = np.linalg.solve(slopes, there - curved)
    plane = np.linalg.lstsq(np.stack([np.ones_like(i), i, j], axis=1), home.T, rcond=None)[0][0]
    told = _taken_for_a_shift(warp, np.linalg.inv(slopes)[None], 8)[0]
    # Third and fourth order: the slope changes by 8 * 8e-4 over the square, and 17 x 17 px are no continuum.
    assert told == pytest.approx(plane, rel=0.02, abs=1e-5)
    assert np.hypot(*plane) > 0.005


@pytest.mark.parametrize(("own", "other"), [(0.44, 0.44), (0.69, 0.69), (0.5, 1.1)])
def test_spots_are_measured_where_a_view_is_foreshortened(own: float, other: float) -> None:
    """From what subsets leave over that are told of the least spots; where there is no more, nothing is."""
    across = np.diag([0.75, 1.0])
    images = prepare_images(
        spots(np.eye(2), own), spots(across, other), np.ones((SIZE, SIZE), np.int32), spots=(BLUR, BLUR)
    )
    x, y = (values.ravel() for values in np.meshgrid(np.arange(40, 81, 8), np.arange(40, 81, 8)))
    guess = np.zeros((len(x), 6))
    guess[:, 0], guess[:, 1] = -0.25 * (x - SIZE / 2.0), -0.25
    settings = MatchSettings(RADIUS)
    found = measured_spots(images, x, y, match_points(images, x, y, guess, settings), settings)
    # To the first order a wave k is told b k^2 / 2 for 1 - exp(-b k^2 / 2), b k^2 / 4 too much: a quarter for
    # the finest that these spots of 1.2 px have, k = 1 / px.
    assert np.abs(np.array(found) - [own, other]).max() < 0.25 * max(own, other)
    assert found[1] - found[0] == pytest.approx(other - own, abs=0.01 + 0.25 * (other - own))


def test_spots_are_as_told_where_nothing_tells_them() -> None:
    image = spots(np.eye(2), BLUR)
    images = prepare_images(image, image, np.ones((SIZE, SIZE), np.int32), spots=(BLUR, BLUR))
    none, settings = np.zeros(0, dtype=np.int64), MatchSettings(RADIUS)
    nothing = match_points(images, none, none, np.zeros((0, 6)), settings)
    assert measured_spots(images, none, none, nothing, settings) == (BLUR, BLUR)
    x = np.arange(40, 81, 8)
    alike = match_points(images, x, x, np.zeros((len(x), 6)), settings)
    assert measured_spots(images, x, x, alike, settings) == pytest.approx((BLUR, BLUR), abs=1e-6)
