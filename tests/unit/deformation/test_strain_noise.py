"""Strain by noise that has passed subsets scatters as is stated, of discs and of gauges' rectangles."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy import signal

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.averaging import average_in_region
from sms_jobs.metrology.deformation.fields.border_noise import beside_borders
from sms_jobs.metrology.deformation.fields.displacement import blending_reach
from sms_jobs.metrology.deformation.fields.noise_correlation import blended_weights
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace, read_gauge
from sms_jobs.metrology.deformation.strain.strain_errors import (
    MatchedShape,
    Window,
    seen_of_match,
    shared_errors,
)
from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain

SIZE, MARGIN, TRIALS = 110, 28, 60
ONE = np.ones((SIZE, SIZE), np.int32)
INNER = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]


def flat() -> Floats:
    row, column = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    return np.stack([column, -row, np.zeros_like(row)])


def filtered(subsets: Subsets, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return a displacement in x and y by noise through subsets, and the covariance that is stated of it."""
    weights, stated = blended_weights(subsets)
    size = SIZE + len(weights) - 1
    moved = np.zeros((3, SIZE, SIZE))
    for axis in (0, 1):
        moved[axis] = signal.fftconvolve(rng.normal(size=(size, size)), weights, mode="valid")
    covariance = np.zeros((6, SIZE, SIZE))
    covariance[[0, 3]] = stated
    return moved, covariance


@pytest.mark.parametrize("of", ["match in time", "shape", "bias"])
def test_noise_through_subsets_is_stated(rng: np.random.Generator, of: str) -> None:
    """60 trials at some six independent places: 4 % of a deviation for each of three strains."""
    in_time, between, disc = Subsets(6, 1), Subsets(8, 2), 9.0
    subsets = between if of == "shape" else in_time
    squares = []
    for _ in range(TRIALS):
        moved, covariance = filtered(subsets, rng)
        errors = shared_errors(
            covariance,
            np.zeros_like(covariance),
            covariance if of == "bias" else None,
            averaging_radius_px=0.0,
            subset_radius_px=in_time.radius,
            disc_radius_px=disc,
            shape=MatchedShape(0.5 * covariance, between) if of == "shape" else None,
        )
        found = surface_strain(flat(), moved, errors, ONE, gauge_length=2.0 * disc, green_lagrange=False)
        squares.append((found.strain**2 / (found.sigma**2 - found.bias**2))[:, *INNER])
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=(0, 2, 3))), 1.0, atol=0.1)


def test_noise_is_stated_where_it_is(rng: np.random.Generator) -> None:
    """Four times as much noise at one side, as where light falls off: 5 % of a deviation in each third."""
    subsets, disc = Subsets(6, 1), 9.0
    loud = np.geomspace(0.5, 2.0, SIZE)
    squares = []
    for _ in range(TRIALS):
        moved, covariance = filtered(subsets, rng)
        errors = shared_errors(
            loud**2 * covariance,
            np.zeros_like(covariance),
            averaging_radius_px=0.0,
            subset_radius_px=subsets.radius,
            disc_radius_px=disc,
        )
        found = surface_strain(
            flat(), loud * moved, errors, ONE, gauge_length=2.0 * disc, green_lagrange=False
        )
        score = (found.strain**2 / (found.sigma**2 - found.bias**2))[:, *INNER]
        squares.append([third.mean() for third in np.array_split(score, 3, axis=2)])
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=0)), 1.0, atol=0.15)


def test_noise_of_a_narrow_plate_is_that_of_its_middle() -> None:
    """Of five radii, where most matches see an edge, by which median noise would be up to 13 % smaller."""
    subsets = Subsets(10, 1)
    plate = np.zeros((SIZE, SIZE), np.int32)
    plate[10:100, 30:80] = 1
    stated = blended_weights(subsets)[1]
    beside = beside_borders(plate, subsets.radius, blending_reach(1, 6), 3)[0]
    covariance = np.full((6, SIZE, SIZE), np.nan)
    covariance[:, plate > 0] = 0.0
    covariance[[0, 3]] += stated * beside
    told = shared_errors(
        covariance,
        np.zeros_like(covariance),
        averaging_radius_px=0.0,
        subset_radius_px=subsets.radius,
        disc_radius_px=15.0,
    ).match[0, plate > 0]
    np.testing.assert_allclose(told / seen_of_match(subsets, 15.0), stated, rtol=0.02)


@pytest.mark.parametrize("subsets", [Subsets(10, 1), Subsets(12, 2)])
def test_wide_discs_see_as_many_pixels_as_a_match_is_made_of(subsets: Subsets) -> None:
    """Of the slowest waves a match keeps all: what counts is a pixel's variance over the stated one."""
    weights, stated = blended_weights(subsets)
    assert np.sum(weights) == pytest.approx(1.0)
    wide, wider = (seen_of_match(subsets, radius) for radius in (8.0 * subsets.radius, 1e4))
    assert wide < wider < 1.0 / stated
    assert wider * stated == pytest.approx(1.0, abs=0.05)


def test_a_bias_that_subsets_do_not_follow_is_stated_whichever_way_it_waves() -> None:
    """Waves of one to four subsets, over discs of half to twice a subset: none is a silent error.

    Of two strains along one wave the one along it has all of the error, so that the mean square is within
    the bound of 8 that the worst length and direction have, 2.8 of one deviation.
    """
    for radius_px, disc, subsets_long in product((5, 10), (0.7, 1.5), (1.0, 2.0, 4.0)):
        period, reach = subsets_long * (2 * radius_px + 1), disc * radius_px
        xyz = flat()
        wrong = np.zeros_like(xyz)
        wrong[0] = np.sin(2.0 * np.pi * xyz[0] / period)
        bias = np.zeros((6, SIZE, SIZE))
        bias[0] = 0.5
        errors = shared_errors(
            bias,
            np.zeros_like(bias),
            bias,
            averaging_radius_px=0.0,
            subset_radius_px=radius_px,
            disc_radius_px=reach,
        )
        found = surface_strain(xyz, wrong, errors, ONE, gauge_length=2.0 * reach, green_lagrange=False)
        sigma = np.sqrt(found.sigma**2 - found.bias**2)[0][INNER]
        assert np.sqrt(np.mean((found.strain[0][INNER] / sigma) ** 2)) < np.sqrt(8.0)


@pytest.mark.parametrize(
    ("in_time", "between", "length", "width"),
    [
        (Subsets(6, 1), None, 25.0, 9.0),  # a long gauge is quieter than the disc of its area
        (Subsets(7, 1), None, 15.0, 7.0),
        (Subsets(7, 1), Subsets(7, 2), 15.0, 7.0),
    ],
)
def test_a_gauge_sees_the_subsets_that_were_matched(
    rng: np.random.Generator, in_time: Subsets, between: Subsets | None, length: float, width: float
) -> None:
    """Over its own rectangle, by the noise of either. 60 trials at some 8 places: 3 % of a deviation."""
    scores = []
    for _ in range(TRIALS):
        moved, covariance = filtered(between or in_time, rng)
        errors = shared_errors(
            covariance,
            np.zeros_like(covariance),
            averaging_radius_px=0.0,
            subset_radius_px=in_time.radius,
            disc_radius_px=float(np.sqrt(length * width / np.pi)),
            shape=None if between is None else MatchedShape(0.5 * covariance, between),
            window=Window.nearest(length, width),
        )
        for x, y, angle in product((30.0, 55.0, 80.0), (-30.0, -55.0, -80.0), (0.0, 0.8, np.pi / 2.0)):
            place = GaugePlace(x, y, length, width, angle)
            read = read_gauge(place, flat(), moved, errors.every, ONE, green_lagrange=False)
            scores.append(read.strain / read.sigma)
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize("times", [0.8, 1.3])
def test_what_lies_along_rays_is_shapes_however_much_it_is(rng: np.random.Generator, times: float) -> None:
    """Averages have some times the noise that the cloud tells: no match moves points along a ray.

    60 trials at some six independent places: 4 % of a deviation; 10 % by the fitted factor. 0.3 of it, taken
    for noise of matches, states strain 1.15 times too large.
    """
    radius, disc, subsets = 4.0, 9.0, Subsets(6, 1)
    ray = np.array([0.6, 0.0, 0.8])
    line = np.outer(ray, ray)[np.triu_indices(3)][:, None, None]
    cloud = 0.5 * line * np.ones((6, SIZE, SIZE))
    squares = []
    for _ in range(TRIALS):
        raw = np.sqrt(times) * ray[:, None, None] * rng.normal(size=(SIZE, SIZE))
        weighs = np.zeros((6, SIZE, SIZE))
        weighs[[0, 3, 5]] = 1.0
        moved, _ = average_in_region(raw, weighs, ONE, ONE > 0, radius)
        by_match, of_match = filtered(subsets, rng)
        errors = shared_errors(
            times * 2.0 * cloud / (5.0 * np.pi / 9.0 * radius**2) + 0.1 * of_match,
            cloud,
            averaging_radius_px=radius,
            subset_radius_px=subsets.radius,
            disc_radius_px=disc,
        )
        moved += np.sqrt(0.1) * by_match
        found = surface_strain(flat(), moved, errors, ONE, gauge_length=2.0 * disc, green_lagrange=False)
        squares.append((found.strain**2 / (found.sigma**2 - found.bias**2))[:, *INNER])
    np.testing.assert_allclose(np.sqrt(np.mean(squares, axis=(0, 2, 3))), 1.0, atol=0.1)
