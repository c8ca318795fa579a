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


def outside(found: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> int:
    """Return how many pixels within a gap of the strip, and more than 1 px off, are said to be textured."""
    distance = distance_inside()
    return int((found & (distance < -1.0) & (distance > -2.0 * COARSEST)).sum())


def test_an_outline_does_not_depend_on_noise(rng: np.random.Generator) -> None:
    """A tenth of a pixel along 508 px of outline, which a lens blurs by 1 px.

    Told by five deviations of noise alone it is 0.8 px wider with a third of the noise.
    """
    light = ndimage.gaussian_filter(strip(rng, 2.0), 1.0)
    areas = []
    for noise in (0.3, 1.0):
        found = textured_pixels(light + rng.normal(0.0, noise, SHAPE), noise**2, COARSEST)
        assert not outside(found)
        areas.append(int(found.sum()))
    assert abs(areas[0] - areas[1]) < 0.1 * 508


@pytest.mark.parametrize("part", [0.05, 0.1, 0.15])
def test_what_is_far_weaker_beside_a_texture_is_none_of_it(rng: np.random.Generator, part: float) -> None:
    """A window is reflected in a specimen and in what is plain beside it."""
    shape, edge = (240, 320), 160
    speckle, reflected = (ndimage.gaussian_filter(rng.normal(size=shape), 2.0) for _ in range(2))
    beside = np.arange(shape[1]) - edge
    levels = np.where(beside < 0, 120.0 + 40.0 * speckle / speckle.std(), 10.0)
    levels += part * 40.0 * reflected / reflected.std() + rng.normal(0.0, 0.2, shape)
    found = textured_pixels(levels, 0.2**2, COARSEST)
    assert found[:, beside < -4].all()
    assert not found[:, (beside > 2) & (beside < 2 * COARSEST)].any()


def test_what_a_lossy_file_adds_is_none_of_the_texture(rng: np.random.Generator) -> None:
    import cv2

    grey = np.clip(np.rint(strip(rng, 2.0)), 0, 255).astype(np.uint8)
    packed = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 40])[1]
    unpacked = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE)
    assert unpacked is not None
    found = textured_pixels(unpacked.astype(np.float64), NOISE**2, COARSEST)
    assert not outside(found)
    assert found[distance_inside() > 4.0].all()


@pytest.mark.parametrize("blur_px", [1.0, 2.0])
def test_a_smeared_rim_is_no_wider_specimen(rng: np.random.Generator, blur_px: float) -> None:
    levels = ndimage.gaussian_filter(strip(rng, 2.0), blur_px) + rng.normal(0.0, 0.2, SHAPE)
    found = textured_pixels(levels, 0.2**2, COARSEST)
    assert not found[distance_inside() < -blur_px].any()
    assert found[distance_inside() > 3.0 + blur_px].all()


def test_a_strong_mark_leaves_the_weaker_texture_about_it(rng: np.random.Generator) -> None:
    """A coded target, or a printed scale, has many times the contrast of a speckle."""
    speckle = ndimage.gaussian_filter(rng.normal(size=SHAPE), 2.0)
    levels = 100.0 + 20.0 * speckle / speckle.std() + rng.normal(0.0, NOISE, SHAPE)
    levels[60:90, 80:110] = 250.0 * (np.indices((30, 30)).sum(axis=0) // 10 % 2)
    assert textured_pixels(levels, NOISE**2, COARSEST).all()


def test_a_bright_background_leaves_the_weaker_texture_beside_it(rng: np.random.Generator) -> None:
    """The step at the outline has many times the contrast of what ends there."""
    speckle = ndimage.gaussian_filter(rng.normal(size=SHAPE), 2.0)
    levels = np.where(distance_inside() > 0.0, 60.0 + 10.0 * speckle / speckle.std(), 250.0)
    found = textured_pixels(levels + rng.normal(0.0, NOISE, SHAPE), NOISE**2, COARSEST)
    assert found[distance_inside() > 4.0].all()


def test_a_shaded_part_has_a_usual_texture_of_its_own(rng: np.random.Generator) -> None:
    """Beside a shadow's edge what is weak is left out; farther inside it is measured.

    It has 0.04 of the variance. Some windows happen to show 3.5 times as much, and gaps between them are
    closed: all of it is texture by noise alone, a fifth is left here, and three tenths are allowed.
    """
    rows, columns = 160, 500
    speckle = ndimage.gaussian_filter(rng.normal(size=(rows, columns)), 2.0)
    light = np.where(np.arange(columns) < 250, 1.0, 0.2)
    levels = light * (120.0 + 40.0 * speckle / speckle.std()) + rng.normal(0.0, 0.2, (rows, columns))
    found = textured_pixels(levels, 0.2**2, COARSEST)
    assert found[:, :245].all()
    assert found[:, 260:290].mean() < 0.3
    assert found[:, 350:].all()


def test_what_is_usual_of_dots_is_told_through_the_gaps_between_them(rng: np.random.Generator) -> None:
    """Dots 18 px apart on plain paint, before a background with a weak texture of its own."""
    shape, edge = (240, 320), 165
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]]
    dots = np.hypot(row % 18 - 9, column % 18 - 9) < 4.0
    behind = ndimage.gaussian_filter(rng.normal(size=shape), 2.0)
    levels = np.where(column < edge, np.where(dots, 30.0, 140.0), 40.0 + 4.0 * behind / behind.std())
    found = textured_pixels(levels + rng.normal(0.0, 0.2, shape), 0.2**2, COARSEST)
    assert found[30:-30, 30 : edge - 15].all()
    assert not found[:, edge + 3 : edge + 2 * COARSEST].any()
