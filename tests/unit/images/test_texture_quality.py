"""Advice about a texture, against what matching it really gives."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.app.fields.textures import Image, advise
from sms_jobs.bench.correlated.speckle_pairs import shift, speckle_pair
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.images.texture_quality import (
    examine_texture,
    gauge_sigma,
    likeness_of_neighbours,
    match_sigma,
    noise_of_pair,
    suggested_radius,
)

SIZE, NOISE, RADIUS = 160, 12.0, 10


@pytest.fixture(scope="module")
def pair() -> tuple[np.ndarray, np.ndarray]:
    return speckle_pair(SIZE, shift(0.3, -0.2), 5)


def test_the_noise_of_a_pair_is_found_whatever_the_light(pair: tuple[np.ndarray, np.ndarray]) -> None:
    rng = np.random.default_rng(1)
    first, second = (pair[0] * light + rng.normal(0.0, NOISE, pair[0].shape) for light in (1.0, 1.01))
    # 25600 differences: a standard deviation to 1 / sqrt(2 n) = 0.5 %, and a little more within a cut.
    assert noise_of_pair(first, second) == pytest.approx(NOISE, rel=0.03)


@pytest.mark.parametrize("sigma", [0.3, 0.6, 1.0, 1.4, 3.0])
@pytest.mark.parametrize("light", [1.0, 1.05])
def test_the_noise_of_8_bit_pairs_is_no_multiple_of_anything(sigma: float, light: float) -> None:
    rng = np.random.default_rng(3)
    level = rng.uniform(20.0, 200.0, (SIZE, SIZE))
    first, second = (np.rint(level * k + rng.normal(0.0, sigma, level.shape)) for k in (1.0, light))
    # Brought to the first's brightness the second's noise is less by as much: 2.4 % for both, at most.
    assert noise_of_pair(first, second) == pytest.approx(np.sqrt(sigma**2 + 1.0 / 12.0), rel=0.05)


def test_slopes_and_contrast_do_not_count_the_noise(pair: tuple[np.ndarray, np.ndarray]) -> None:
    rng = np.random.default_rng(2)
    clean = examine_texture(pair[0], 0.0, 4095.0)
    noisy = examine_texture(pair[0] + rng.normal(0.0, 40.0, pair[0].shape), 40.0, 4095.0)
    # Noise adds 0.9 x 1600 to slopes squared of 25000; over 25600 pixels that scatters by 1 %.
    power = [np.mean(texture.slope_power, axis=(1, 2)) for texture in (noisy, clean)]
    assert power[0] == pytest.approx(power[1], rel=0.02)
    assert noisy.speckle_px == pytest.approx(clean.speckle_px, rel=0.02)
    # Blobs exp(-d^2 / (2 w^2)): autocorrelation exp(-d^2 / (4 w^2)), full width 4 w sqrt(ln 2) = 6 px.
    assert clean.speckle_px == pytest.approx(4.0 * 1.8 * np.sqrt(np.log(2.0)), rel=0.1)
    assert suggested_radius(clean) == int(np.ceil(2.5 * clean.speckle_px))


def test_the_expected_sigma_is_the_scatter_of_real_matches(pair: tuple[np.ndarray, np.ndarray]) -> None:
    rng = np.random.default_rng(3)
    texture = examine_texture(pair[0], NOISE, 4095.0)
    y, x = (c.ravel() for c in np.mgrid[20:140:24, 20:140:24])
    guess = np.zeros((len(x), 6))
    guess[:, 0], guess[:, 3] = 0.3, -0.2
    found = []
    for _ in range(12):
        noisy = [image + rng.normal(0.0, NOISE, image.shape) for image in pair]
        noise = Noise(NOISE**2, 0.0)
        images = prepare_images(noisy[0], noisy[1], np.ones((SIZE, SIZE), np.int32), (noise, noise))
        matches = match_points(images, x, y, guess, MatchSettings(RADIUS))
        assert (matches.ending == CONVERGED).all()
        found.append(matches.warp[:, [0, 3]] - [0.3, -0.2])
    # 600 values scatter by 3 %, the 25 subsets are not all subsets, and an affine one that holds few speckles
    # loses some of its slopes to the other parameters: 10 % here.
    assert np.std(found) / match_sigma(texture, RADIUS) == pytest.approx(1.05, abs=0.1)


def test_strain_falls_with_gauge_length_as_the_lever_says(pair: tuple[np.ndarray, np.ndarray]) -> None:
    texture = examine_texture(pair[0], NOISE, 4095.0)
    sigma = [gauge_sigma(texture, RADIUS, g) for g in (200.0, 400.0)]
    # Much longer than the subset: the square of the length, and the filter's last 1.25 %, 3.6 %.
    assert sigma[0] / sigma[1] == pytest.approx(4.0, rel=0.03)
    # Independent pixels on a disc, fitted in fact.
    offset = np.arange(-100, 101)
    inside = offset**2 + offset[:, None] ** 2 <= 100**2
    moments = np.sum((offset**2 * np.ones((201, 1)))[inside])
    exact = match_sigma(texture, RADIUS) * 21 / np.sqrt(moments)
    assert sigma[0] == pytest.approx(exact / (1.0 + 0.25 * 0.1 + 1.27 * 0.01), rel=0.01)


def image_of(name: str, levels: np.ndarray) -> Image:
    return Image(name, np.clip(np.rint(levels), 0, 4095).astype(np.uint16), 4095.0, None)


def test_a_pair_that_has_moved_is_told_from_noise(pair: tuple[np.ndarray, np.ndarray]) -> None:
    rng = np.random.default_rng(4)
    first, second, moved = (
        one + rng.normal(0.0, NOISE, one.shape) for one in (pair[0], 1.1 * pair[0], pair[1])
    )
    second[40:44, 40:44] = 4000.0  # dust that came between counts as little as with the noise
    # The correlation of white noise over 2 x 25600 pairs scatters by 0.005.
    assert abs(likeness_of_neighbours(first, second)) < 0.02
    assert likeness_of_neighbours(first, moved) > 0.5
    at_rest = advise(image_of("a", first), image_of("b", second))
    in_motion = advise(image_of("a", first), image_of("b", moved))
    assert not any("alike" in remark for remark in at_rest.remarks)
    assert any("alike" in remark and "at rest" in remark for remark in in_motion.remarks)


def test_an_image_tells_no_noise_with_itself(pair: tuple[np.ndarray, np.ndarray]) -> None:
    found = advise(image_of("a", pair[0]), image_of("a again", pair[0]))
    assert found.noise is None
    assert any("a again is the same image" in remark for remark in found.remarks)


def test_a_texture_that_repeats_itself_is_remarked_on(pair: tuple[np.ndarray, np.ndarray]) -> None:
    y, x = np.mgrid[:SIZE, :SIZE]
    weave = 2000.0 + 800.0 * np.cos(2.0 * np.pi * x / 12.0) * np.cos(2.0 * np.pi * y / 12.0)
    weave += np.random.default_rng(6).normal(0.0, NOISE, weave.shape)
    (said,) = (one for one in advise(image_of("a", weave)).remarks if "repeats" in one)
    assert "at 25 of 25 places" in said
    assert not any("repeats" in one for one in advise(image_of("a", pair[0])).remarks)


def test_black_and_blank_images_get_words_and_no_radius() -> None:
    black = image_of("black", np.zeros((SIZE, SIZE)))
    grey = image_of("grey", np.random.default_rng(5).normal(70.0, 2.0, (SIZE, SIZE)))
    for pair_of in ((black, black), (grey, black), (black, grey)):
        found = advise(*pair_of)
        assert found.least_radius_px is None or found.texture.contrast > 0.0
        assert any("grey levels are used" in remark for remark in found.remarks)
