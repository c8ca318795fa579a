"""What the images say of a displacement: what it is off by, and where they show something else."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from support.matched import spread_over_pixels

from sms_jobs.metrology.deformation.matching.correlation import Noise, PreparedImages, prepare_images
from sms_jobs.metrology.deformation.matching.verification import Verified, verify_displacement
from sms_jobs.metrology.images.smoothing import noise_after_smoothing, smooth

SIZE, RADIUS, SMOOTHING, NOISE = 160, 10, 0.6, 20.0
INNER = np.s_[:, 30:-30, 30:-30]
SHIFT = (0.4, -0.3)
"""Of the second image, in px."""


@cache
def levels(pattern_of: object, seed: int) -> tuple[np.ndarray, np.ndarray]:
    pattern = pattern_of.random(seed, SIZE)  # type: ignore[attr-defined]
    return pattern.image(SIZE), pattern.image(SIZE, lambda x, y: (x - SHIFT[0], y - SHIFT[1]))


def prepared(pattern_of: object, told: float = NOISE, true: float = NOISE, seed: int = 3) -> PreparedImages:
    rng = np.random.default_rng(seed)
    return prepare([one + rng.normal(0.0, true, one.shape) for one in levels(pattern_of, seed)], told)


def prepare(recorded: list[np.ndarray], told: float) -> PreparedImages:
    images = [smooth(one, SMOOTHING) for one in recorded]
    factor = noise_after_smoothing(images[0], np.ones((SIZE, SIZE), bool), SMOOTHING)
    noise = Noise(told**2 * factor, 0.0)
    return prepare_images(*images, np.ones((SIZE, SIZE), np.int32), (noise, noise))


def measured(images: PreparedImages) -> np.ndarray:
    """Return the displacement of every pixel as subsets find it: it follows their noise."""
    return spread_over_pixels(images, RADIUS)[0]


def verified(images: PreparedImages, image: np.ndarray, threads: int = 1) -> Verified:
    return verify_displacement(images, image, RADIUS, 1, SMOOTHING, threads)


def test_of_what_subsets_find_nothing_is_said(speckle: object) -> None:
    images = prepared(speckle)
    found = verified(images, measured(images))
    # Three standard errors of a skew mean on three scales, and four of each window, of which some pass.
    assert np.mean(found.bias[INNER] > 0.0) < 0.15
    assert np.sqrt(found.bias[INNER].mean()) < 0.01
    assert np.mean(found.agrees) > 0.995
    assert not found.unlike.any()


@pytest.mark.parametrize("off", [0.05, 0.1, 0.3])
def test_what_it_is_off_by_is_found(speckle: object, off: float) -> None:
    """The mean square that windows ask for, which noise of 0.02 px a window disturbs, times 1.25."""
    images = prepared(speckle)
    image = measured(images)
    image[0] += off
    found = verified(images, image)
    # Some ten independent windows in the smallest square: 40 % of a variance, 20 % of its root.
    assert np.sqrt(np.median(found.bias[0][INNER[1:]])) == pytest.approx(np.sqrt(1.25) * off, rel=0.25)
    assert np.sqrt(np.mean(found.bias[1][INNER[1:]])) < 0.5 * off


def test_a_part_that_went_elsewhere_is_another_thing(speckle: object) -> None:
    """Three pixels, more than half a speckle: no step of any size mends that."""
    images = prepared(speckle)
    image, edge = measured(images), 2 * SIZE // 3
    image[0, :, edge:] += 3.0
    found = verified(images, image)
    assert np.mean(found.agrees[30:-30, edge + 4 : -30]) < 0.1
    assert np.mean(found.unlike[30:-30, edge + 4 : -30]) > 0.75
    assert np.mean(found.agrees[30:-30, 30 : edge - 4]) > 0.99
    assert not found.unlike[:, : edge - 4].any()


def test_the_borders_of_the_image_are_looked_at_too(speckle: object) -> None:
    """Matches are carried to the border: what they are off by there only the border's own pixels tell."""
    images = prepared(speckle)
    image = measured(images)
    image[0, :, -6:] += 0.3
    found = verified(images, image)
    rows = np.s_[30:-30]
    # Windows see all but 3 px of it, and the smallest square about the last pixel holds nothing else.
    assert np.sqrt(np.median(found.bias[0, rows, -1])) > 0.15
    assert np.sqrt(np.median(verified(images, measured(images)).bias[0, rows, -5:])) < 0.01


def test_noise_that_nobody_told_of_is_no_bias(speckle: object) -> None:
    """Three times the noise: it scatters from pixel to pixel as noise does."""
    images = prepared(speckle, told=NOISE / 3.0)
    found = verified(images, measured(images))
    assert np.mean(found.bias[INNER] > 0.0) < 0.15
    assert np.mean(found.agrees) > 0.99


def test_what_shows_across_rays_too_is_made_by_the_images(speckle: object) -> None:
    """A haze over one image, coarser than pixels; along columns no shape would move a match."""
    rng = np.random.default_rng(7)
    haze = ndimage.gaussian_filter(rng.normal(0.0, 1.0, (SIZE, SIZE)), 1.5)
    first, second = (one + rng.normal(0.0, NOISE, one.shape) for one in levels(speckle, 3))
    images = prepare([first, second + 2.0 * NOISE * haze / haze.std()], NOISE)
    image = measured(images)
    across = np.stack([np.zeros((SIZE, SIZE)), np.ones((SIZE, SIZE))])

    def asked(off: float, ways: np.ndarray | None) -> np.ndarray:
        moved = image + np.array([off, 0.0])[:, None, None]
        found = verify_displacement(images, moved, RADIUS, 1, SMOOTHING, across=ways)
        return np.asarray(found.bias[INNER].mean(axis=(1, 2)))

    by_haze = asked(0.0, across)
    # What stays are single windows, and what changes slowly; means over squares go.
    assert (by_haze < 0.5 * asked(0.0, None)).all()
    # What rows are off by is found all the same: 290 independent windows tell a mean square to 8 %.
    more = asked(0.2, across) - by_haze
    assert np.sqrt(more[0]) == pytest.approx(np.sqrt(1.25) * 0.2, rel=0.15)
    assert abs(more[1]) < 0.1 * more[0]


def test_images_without_noise_are_judged_by_what_they_show(speckle: object) -> None:
    """Nobody's noise is nought: rounding and splines leave something, and that is what there is to go by."""
    images = prepared(speckle, told=0.0, true=0.0)
    image = measured(images)
    found = verified(images, image)
    assert np.isfinite(found.bias).all()
    assert np.sqrt(found.bias[INNER].mean()) < 0.01
    assert found.agrees.all()
    image[0] += 0.1
    off = verified(images, image)
    assert np.sqrt(np.median(off.bias[0][INNER[1:]])) == pytest.approx(np.sqrt(1.25) * 0.1, rel=0.25)


def test_where_there_is_no_displacement_nothing_is_judged(speckle: object) -> None:
    images = prepared(speckle)
    image = measured(images)
    image[:, 40:90, 50:100] = np.nan
    found = verified(images, image)
    hole = np.isnan(image[0])
    assert (found.bias[:, hole] == 0.0).all()
    assert found.agrees[hole].all()
    assert np.mean(found.agrees) > 0.995


def test_neither_threads_nor_bands_change_anything(speckle: object) -> None:
    """Of an image thrice as high, rows 256 and on are another band than the same rows of its first third."""
    images = prepared(speckle)
    image = measured(images)
    image[0] += 0.1
    tall = prepare_images(
        np.tile(images.reference, (3, 1)), np.tile(images.deformed, (3, 1)),
        np.ones((3 * SIZE, SIZE), np.int32), images.noise,
    )  # fmt: skip
    one, two = (verified(tall, np.tile(image, (1, 3, 1)), threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.bias, two.bias)
    np.testing.assert_array_equal(one.agrees, two.agrees)
    # What a band takes for typical weighs windows a little differently.
    np.testing.assert_allclose(
        np.sqrt(one.bias[0, 246:270, 45:-45]), np.sqrt(one.bias[0, 86:110, 45:-45]), rtol=0.1
    )


def test_dust_on_the_sensor_is_bias(speckle: object) -> None:
    """It rests while the texture moves: some pixels were off by 7.5 deviations of what was stated."""
    row, column = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    gain, near = np.ones((SIZE, SIZE)), np.zeros((SIZE, SIZE), bool)
    for x, y in ((55, 55), (105, 55), (55, 105), (105, 105)):
        distance = np.hypot(column - x, row - y)
        gain *= 1.0 - 0.3 * np.exp(-0.5 * (distance / 7.0) ** 2)
        near |= distance < 12.0
    for seed in range(3, 7):
        rng = np.random.default_rng(seed)
        images = prepare(
            [one * gain + rng.normal(0.0, NOISE, one.shape) for one in levels(speckle, seed)], NOISE
        )
        image = measured(images)
        square = (image - np.array(SHIFT).reshape(2, 1, 1)) ** 2
        stated = np.mean(square[:, ~near]) + verified(images, image).bias
        # Beyond six deviations a value is silently wrong, whatever its errors' distribution.
        assert (square < 36.0 * stated)[:, near].all()


@pytest.mark.parametrize(("share", "darker"), [(1e-3, 1500.0), (3e-4, 2500.0)])
def test_bad_pixels_of_the_sensor_have_pulled_the_match(speckle: object, share: float, darker: float) -> None:
    """They rest while the texture moves, and 1,650 and 158 of a million values were off by more than six."""
    beyond, count = 0, 0
    for seed in range(3, 9):
        rng = np.random.default_rng(seed)
        bad = (rng.random((SIZE, SIZE)) < share) * darker
        images = prepare(
            [one - bad + rng.normal(0.0, NOISE, one.shape) for one in levels(speckle, seed)], NOISE
        )
        exact = np.array(SHIFT).reshape(2, 1, 1)
        still = np.mean((measured(prepared(speckle, seed=seed)) - exact)[INNER] ** 2)
        image = measured(images)
        square = (image - exact)[INNER] ** 2
        beyond += int(np.count_nonzero(square > 36.0 * (still + verified(images, image).bias[INNER])))
        count += square.size
    assert beyond < 1e-4 * count
