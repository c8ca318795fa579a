"""Beside an edge errors that go together disturb strain more: as much as is stated there."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.fields.displacement import ImagePoints, blend_matches
from sms_jobs.metrology.deformation.strain.strain_errors import shared_errors
from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain

ROWS, COLUMNS, RADIUS, DISC = 130, 100, 6, 9
TRIALS = 40


def flat() -> np.ndarray:
    row, column = np.mgrid[0:ROWS, 0:COLUMNS].astype(np.float64)
    return np.stack([column, -row, np.zeros_like(row)])


def matched(noise: np.ndarray, last: int) -> ImagePoints:
    """Return what subsets of first order make of white noise (2, rows, columns) in columns up to `last`."""
    x, y, warp, sigma = [], [], [], []
    down = np.arange(-RADIUS, RADIUS + 1)
    for column in range(RADIUS, last + 1, 3):
        right = np.arange(-RADIUS, min(RADIUS, last - column) + 1)
        dx, dy = np.meshgrid(right, down)
        design = np.stack([np.ones(dx.size), dx.ravel(), dy.ravel()], axis=1)
        inverse = np.linalg.inv(design.T @ design)
        for row in range(RADIUS, ROWS - RADIUS, 3):
            part = noise[:, row + down[0] : row + down[-1] + 1, column + right[0] : column + right[-1] + 1]
            warp.append((part.reshape(2, -1) @ design @ inverse).ravel())
            sigma.append([np.sqrt(inverse[0, 0])] * 2)
            x.append(column)
            y.append(row)
    return ImagePoints(np.array(x), np.array(y), np.ones(len(x), np.int32), np.array(warp), np.array(sigma))


@pytest.mark.parametrize(
    ("rim", "disc"), [(3, DISC), (1, RADIUS)], ids=["wide rim", "disc as small as a subset"]
)
def test_the_match_disturbs_strain_beside_an_edge_as_is_computed(
    rng: np.random.Generator, rim: int, disc: int
) -> None:
    """Three columns at a region's edge hold no match: strain across it is 1.7 times as noisy as discs say.

    A disc that is no larger than a subset sees less of errors there than of white noise, which it is told by.

    Of 40 trials at six independent places: 7 % of a deviation; 10 % by matches that are 3 px apart, of which
    the propagation knows nothing. Two of these deviations at single places, one and a half of means."""
    last, outermost = 70, 70 + rim  # the last column that is matched, and the last one of the region
    labels = np.zeros((ROWS, COLUMNS), np.int32)
    labels[:, : outermost + 1] = 1
    squares = []
    for _ in range(TRIALS):
        found = blend_matches(matched(rng.normal(size=(2, ROWS, COLUMNS)), last), flat(), labels, RADIUS)
        value, variance = found.value, found.variance + found.bias
        moved = np.stack([value[0], -value[1], 0.0 * value[0]])
        covariance = np.zeros((6, ROWS, COLUMNS))
        covariance[0], covariance[3] = variance
        covariance[:, np.isnan(value[0])] = np.nan
        errors = shared_errors(
            covariance,
            np.zeros_like(covariance),
            averaging_radius_px=0.0,
            subset_radius_px=RADIUS,
            disc_radius_px=disc,
            match_margin_px=outermost - last,
        )
        found = surface_strain(flat(), moved, errors, labels, gauge_length=2 * disc, green_lagrange=False)
        squares.append(found.strain**2 / (found.sigma**2 - found.bias**2))
    ratio = np.sqrt(np.mean(squares, axis=0)[:, 40:-40].mean(axis=1))
    for distance in (0, 3, 6, 9):
        np.testing.assert_allclose(ratio[:, outermost - distance], 1.0, atol=0.25)
    beside = [outermost - distance for distance in (2, 4, 6, 8)]
    np.testing.assert_allclose(np.mean(ratio[:, beside], axis=1), 1.0, atol=0.17)


@pytest.mark.parametrize("turned", [False, True], ids=["edge across x", "edge across y"])
def test_the_average_disturbs_strain_beside_an_edge_as_is_computed(
    rng: np.random.Generator, turned: bool
) -> None:
    """The outermost column is not averaged over; whichever way the edge lies. Tolerances as above."""
    size, radius, outermost = 100, 4.0, 73
    row, column = np.mgrid[0:size, 0:size].astype(np.float64)
    xyz = np.stack([column, -row, np.zeros_like(row)])
    labels = np.zeros((size, size), np.int32)
    labels[:, : outermost + 1] = 1
    used = np.broadcast_to(column < outermost, labels.shape).copy()
    if turned:
        labels, used = np.ascontiguousarray(labels.T), np.ascontiguousarray(used.T)
    cloud = np.zeros((6, size, size))
    cloud[[0, 3, 5]] = 0.5
    squares = []
    for _ in range(TRIALS):
        moved, averaged = average_in_region(rng.normal(size=xyz.shape), 2.0 * cloud, labels, used, radius)
        errors = shared_errors(
            averaged, cloud, averaging_radius_px=radius, subset_radius_px=0.0, disc_radius_px=6.0
        )
        found = surface_strain(xyz, moved, errors, labels, gauge_length=12.0, green_lagrange=False)
        squares.append(found.strain**2 / (found.sigma**2 - found.bias**2))
    mean = np.mean(squares, axis=0)
    ratio = np.sqrt((np.swapaxes(mean, 1, 2) if turned else mean)[:, 15:-15].mean(axis=1))
    beside = [outermost - distance for distance in (1, 2, 3, 4, 5, 6)]
    np.testing.assert_allclose(np.mean(ratio[:, beside], axis=1), 1.0, atol=0.17)
    np.testing.assert_allclose(np.mean(ratio[:, 30:50], axis=1), 1.0, atol=0.17)


def stated_in_the_middle_of(size: int, rng: np.random.Generator) -> np.ndarray:
    """Return what strain of a square of 50 px states whose errors are those of matches, (3, 50, 50)."""
    side, around = 50, (size - 50) // 2
    part = (..., np.s_[around : around + side], np.s_[around : around + side])
    row, column = np.mgrid[0:size, 0:size].astype(np.float64)
    labels = np.zeros((size, size), np.int32)
    labels[part] = 1
    moved, covariance = np.full((3, size, size), np.nan), np.full((6, size, size), np.nan)
    moved[part] = rng.normal(size=(3, side, side))
    covariance[part] = 0.0
    covariance[(np.s_[[0, 3]], *part[1:])] = 1.0
    errors = shared_errors(
        covariance,
        np.zeros_like(covariance),
        averaging_radius_px=0.0,
        subset_radius_px=RADIUS,
        disc_radius_px=DISC,
        match_margin_px=1.0,
    )
    xyz = np.stack([column, -row, np.zeros_like(row)])
    found = surface_strain(xyz, moved, errors, labels, gauge_length=2 * DISC, green_lagrange=False)
    return np.asarray(np.sqrt(found.sigma[part] ** 2 - found.bias[part] ** 2))


def test_the_border_of_the_image_beyond_a_region_is_no_edge() -> None:
    """Of the same region in an image with a wider margin, strain states the same: to the rounding of sums."""
    near, far = (stated_in_the_middle_of(size, np.random.default_rng(7)) for size in (66, 130))
    np.testing.assert_allclose(near, far, rtol=1e-5)
