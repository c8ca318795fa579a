"""Where texture ends, the specimen ends."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.metrology.images.texture_extent import textured_pixels

SHAPE, NOISE = (160, 200), 1.0
LEFT, RIGHT, CENTRE, RADIUS = 30.0, 170.0, (80.0, 100.0), 30.0
COARSEST = 10


def distance_inside() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return how far each pixel is from the outline of a strip with a hole, positive on the strip, in px."""
    row, column = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    hole = np.hypot(row - CENTRE[0], column - CENTRE[1]) - RADIUS
    return np.minimum(np.minimum(column - LEFT, RIGHT - column), hole)


def strip(rng: np.random.Generator, speckle_px: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    speckle = ndimage.gaussian_filter(rng.normal(size=SHAPE), speckle_px)
    levels = np.where(distance_inside() > 0.0, 120.0 + 40.0 * speckle / speckle.std(), 10.0)
    return levels + rng.normal(0.0, NOISE, SHAPE)


@pytest.mark.parametrize("speckle_px", [1.0, 2.0, 4.0])
def test_the_outline_is_that_of_the_specimen(rng: np.random.Generator, speckle_px: float) -> None:
    found = textured_pixels(strip(rng, speckle_px), NOISE**2, COARSEST)
    distance = distance_inside()
    # The outline is drawn in by 1 px; a window sees an edge as soon as one pixel of it is bright, which is
    # less than its half diagonal of 4 * sqrt(2) = 5.7 px away while 4 are taken off.
    assert not found[distance < -1.0].any()
    assert found[distance > 4.0].all()


def test_neither_noise_nor_a_lone_spot_is_a_specimen(rng: np.random.Generator) -> None:
    dark = 10.0 + rng.normal(0.0, NOISE, SHAPE)
    assert not textured_pixels(dark, NOISE**2, COARSEST).any()
    dark[40, 50] = 200.0
    assert not textured_pixels(dark, NOISE**2, COARSEST).any()


def test_texture_all_over_has_no_outline(rng: np.random.Generator) -> None:
    speckle = ndimage.gaussian_filter(rng.normal(size=SHAPE), 2.0)
    assert textured_pixels(1000.0 + 200.0 * speckle / speckle.std(), NOISE**2, COARSEST).all()


def test_noise_may_grow_with_the_level(rng: np.random.Generator) -> None:
    """A bright plain background is as plain as a dark one, if its own noise is taken into account."""
    levels = strip(rng, 2.0)
    background = distance_inside() <= 0.0
    levels[background] = 900.0 + rng.normal(0.0, 30.0, np.count_nonzero(background))
    variance = np.where(background, 30.0**2, NOISE**2)
    found = textured_pixels(levels, variance, COARSEST)
    # Windows across the edge are far brighter and darker than their noise: they count, and are taken off.
    assert not found[distance_inside() < -2.0].any()
    assert found[distance_inside() > 4.0].all()


def test_a_narrow_background_beside_the_border_is_background(rng: np.random.Generator) -> None:
    """Twelve plain columns are narrower than the coarsest speckle, and no gap in it: nothing follows."""
    levels = strip(rng, 2.0)[:, int(LEFT) - 12 :]
    found = textured_pixels(levels, NOISE**2, COARSEST)
    distance = distance_inside()[:, int(LEFT) - 12 :]
    assert not found[distance < -1.0].any()
    assert found[distance > 4.0].all()
    # Where the specimen goes on beyond the image there is no outline.
    assert found[[0, -1], 40].all()
