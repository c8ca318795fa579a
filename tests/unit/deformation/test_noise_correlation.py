"""How much of an image's noise matches of two kinds of subsets have in common: of filters, and of images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.deformation.fields.displacement import ImagePoints, blend_matches
from sms_jobs.metrology.deformation.fields.noise_correlation import noise_correlation
from sms_jobs.metrology.deformation.matching.correlation import (
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.finer_subsets import Subsets

Floats = np.ndarray

IN_TIME, BETWEEN = Subsets(10, 1), Subsets(12, 2)
SIZE, NOISE, DRAWS = 112, 8.0, 200
PLANE = np.stack([*np.mgrid[0:SIZE, 0:SIZE][::-1].astype(np.float64), np.zeros((SIZE, SIZE))])
LABELS = np.ones((SIZE, SIZE), np.int32)


def blended_fit(asked: Floats, subsets: Subsets, spacing: int) -> Floats:
    """Return the blended displacement of subsets that fit what single pixels ask for, (rows, columns)."""
    side, radius = len(asked), subsets.radius
    offset = np.arange(-radius, radius + 1.0)
    dx, dy = np.meshgrid(offset, offset)
    terms = [np.ones_like(dx), dx, dy, 0.5 * dx**2, dx * dy, 0.5 * dy**2][: (1, 3, 6)[subsets.order]]
    fit = np.linalg.pinv(np.stack([one.ravel() for one in terms], axis=1)).reshape(-1, *dx.shape)
    found = [ndimage.correlate(asked, one, mode="constant") for one in fit]
    y, x = (a.ravel() for a in np.mgrid[radius : side - radius : spacing, radius : side - radius : spacing])
    warp = np.zeros((len(x), 12 if subsets.order == 2 else 6))
    for place, one in zip((0, 1, 2, 6, 7, 8), found, strict=False):
        warp[:, place] = one[y, x]
    labels = np.ones(asked.shape, np.int32)
    plane = np.stack([*np.mgrid[0:side, 0:side][::-1].astype(np.float64), 0.0 * asked])
    points = ImagePoints(x, y, np.ones(len(x), np.int32), warp, np.ones((len(x), 2)))
    return np.asarray(blend_matches(points, plane, labels, radius).value[0])


@pytest.mark.parametrize("between", [Subsets(12, 2), Subsets(7, 2), Subsets(9, 1)])
@pytest.mark.parametrize("in_time", [Subsets(10, 1), Subsets(16, 1), Subsets(8, 2), Subsets(10, 0)])
def test_the_correlation_is_that_of_the_filters(in_time: Subsets, between: Subsets) -> None:
    """What a single pixel does to all blended matches about it, over what is stated of them."""
    impulse = np.zeros((221, 221))
    impulse[110, 110] = 1.0
    first, second = (blended_fit(impulse, one, 1) for one in (in_time, between))
    stated = []
    for one in (in_time, between):
        count = (2 * one.radius + 1.0) ** 2
        # The mean of n pixels; the value of a quadratic has 1 + 2 (5 / 4) of that, but for terms of 1 / n.
        stated.append((0.81 * 3.5 if one.order == 2 else 1.39) / count)
    found = float(np.nansum(first * second)) / np.sqrt(stated[0] * stated[1])
    # Squares of 15 pixels and more: 1 / n is 0.4 %.
    assert found == pytest.approx(noise_correlation(in_time, between), rel=0.01)


def seen(speckle, shift: float, slope: float) -> Floats:
    """Return an image of a texture that is shifted, and stretched about its middle, along x; exact."""

    def source(x: Floats, y: Floats) -> tuple[Floats, Floats]:
        return SIZE / 2 + (x - SIZE / 2 - shift) / (1.0 + slope), y

    return np.asarray(speckle.image(SIZE, source))


def matched(first: Floats, second: Floats, subsets: Subsets, spacing: int, shift: float, slope: float):
    """Return the blended match of one image with another that is shifted and stretched against it."""
    images = prepare_images(first, second, LABELS, (Noise(NOISE**2, 0.0), Noise(NOISE**2, 0.0)))
    rim = subsets.radius + 4
    y, x = (a.ravel() for a in np.mgrid[rim : SIZE - rim : spacing, rim : SIZE - rim : spacing])
    guess = np.zeros((len(x), 12))
    guess[:, 0], guess[:, 1] = shift + slope * (x - SIZE / 2), slope
    found = match_points(images, x, y, guess, MatchSettings(subsets.radius, shape_order=subsets.order))
    points = ImagePoints(
        x, y, np.ones(len(x), np.int32), found.warp, found.sigma, 1.0 / np.fmax(found.misfit, 1.0)
    )
    return blend_matches(points, PLANE, LABELS, subsets.radius)


@pytest.mark.parametrize("noisy", ["start", "end"])
def test_one_noisy_image_moves_both_matches_alike(speckle, noisy: str, rng: np.random.Generator) -> None:
    """As the reference of both matches it moves them one way, as where one ends and the other begins, not."""
    texture = speckle.random(4, SIZE)
    start, end, partner = seen(texture, 0.0, 0.0), seen(texture, 0.37, 0.003), seen(texture, 2.3, -0.05)
    at = np.ix_([0, 1], [44, 68], [44, 68])
    found = []
    for _ in range(DRAWS):
        noise = NOISE * rng.normal(size=start.shape)
        if noisy == "start":
            in_time = matched(start + noise, end, IN_TIME, 4, 0.37, 0.003)
            between = matched(start + noise, partner, BETWEEN, 5, 2.3, -0.05)
        else:
            in_time = matched(start, end + noise, IN_TIME, 4, 0.37, 0.003)
            # From the end on the partner is shifted and stretched by the rest.
            slope = 0.95 / 1.003 - 1.0
            between = matched(end + noise, partner, BETWEEN, 5, 2.3 - 0.37 * (1.0 + slope), slope)
        found.append((in_time.value[at], between.value[at] / np.array([0.95, 1.0])[:, None, None]))
    moved = np.array(found) - np.mean(found, axis=0)
    stated = noise_correlation(IN_TIME, BETWEEN) * np.sqrt(0.25 * in_time.noise[at] * between.noise[at])
    ratio = float(np.mean(np.mean(moved[:, 0] * moved[:, 1], axis=0) / stated))
    # Four places along two axes, near enough independent, scatter by sqrt(2 / DRAWS) each. A texture is not
    # alike everywhere: subsets of some ten blobs by ten weigh them by slopes that differ, by some 5 %.
    expected = 1.0 if noisy == "start" else -1.0
    assert ratio == pytest.approx(expected, abs=4.0 * np.sqrt(2.0 / DRAWS / 8.0) + 0.05)
