"""The thesis's own matching: its sums are the slow ones, its peak is the peak, and its errors are stated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from sms_jobs.metrology.deformation.matching import correlation
from sms_jobs.metrology.deformation.matching.correlation import (
    MatchSettings,
    Noise,
    match_points,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.fourier_newton import (
    correlation_along,
    cross_spectrum,
    match_by_cross_correlation,
    sub_pixel_peak,
)

SIZE = 96


def less_mean(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.where(mask, values - values[mask].mean(), 0.0)


@pytest.fixture(scope="module")
def cut(speckle) -> tuple[np.ndarray, np.ndarray]:
    """Return two sub-images of 15 px that moved by (0.3, -0.2) px, cut to two thirds of their pixels."""
    pattern = speckle.random(5, 40, width=1.5)
    first, second = pattern.image(40), pattern.image(40, lambda x, y: (x - 0.3, y + 0.2))
    mask = np.add.outer(np.arange(15), np.arange(15)) < 18
    window = np.s_[12:27, 12:27]
    return less_mean(first[window], mask), less_mean(second[window], mask)


def continuous(first: np.ndarray, second: np.ndarray, u: float, v: float) -> float:
    """Return C(u, v) of thesis Eq. (3.11)-(3.13), frequency by frequency, the highest left out."""
    m = 30
    n = np.arange(first.shape[0])
    frequency = np.arange(1 - m // 2, m // 2)
    wave = np.exp(-2j * np.pi * np.outer(frequency, n) / m)
    product = np.conj(wave @ first @ wave.T) * (wave @ second @ wave.T)
    shifted = np.exp(2j * np.pi * v * frequency / m)[:, None] * np.exp(2j * np.pi * u * frequency / m)
    return float(np.sum(product * shifted).real) / m**2


def test_whole_shifts_are_the_sums_of_products(cut) -> None:
    first, second = cut
    _, whole = cross_spectrum(first[None], second[None])
    scale = np.linalg.norm(first) * np.linalg.norm(second)
    padded = np.pad(second, 15)
    for u, v in ((0, 0), (3, -2), (-14, 5)):
        moved = padded[15 + v : 30 + v, 15 + u : 30 + u]
        # Thesis Eq. (3.10); rounding.
        assert whole[0, v, u] == pytest.approx(np.sum(first * moved), abs=1e-12 * scale)


def test_between_them_it_is_the_transform_of_the_transforms(cut) -> None:
    first, second = cut
    spectrum, _ = cross_spectrum(first[None], second[None])
    scale = np.linalg.norm(first) * np.linalg.norm(second)
    u, v, h = 0.37, -0.61, 1e-4
    across, down = np.array([u]), np.array([v])
    value, slope, bend = correlation_along(spectrum.reduced_along_y(down), spectrum.along_x, across)
    below, at, above = (continuous(first, second, u + step, v) for step in (-h, 0.0, h))
    assert value[0] == pytest.approx(at, abs=1e-12 * scale)
    # h^2 / 6 of a third derivative of pi^3, and rounding over h and h^2.
    assert slope[0] == pytest.approx((above - below) / (2.0 * h), abs=1e-6 * scale)
    assert bend[0] == pytest.approx((above - 2.0 * at + below) / h**2, abs=1e-5 * scale)
    other, along, _ = correlation_along(spectrum.reduced_along_x(across), spectrum.along_y, down)
    assert other[0] == pytest.approx(at, abs=1e-12 * scale)
    ends = [continuous(first, second, u, v + step) for step in (-h, h)]
    assert along[0] == pytest.approx((ends[1] - ends[0]) / (2.0 * h), abs=1e-6 * scale)


def test_it_ends_at_the_peak_of_the_correlation(cut) -> None:
    first, second = cut
    spectrum, _ = cross_spectrum(first[None], second[None])
    u, v, _, good = sub_pixel_peak(spectrum, 1e-9, 50)
    assert good.all()
    scale = np.linalg.norm(first) * np.linalg.norm(second)
    best = minimize(
        lambda p: -continuous(first, second, *p) / scale, [0.0, 0.0], tol=1e-12, method="Nelder-Mead"
    )
    # A maximum of curvature 0.2 is known to the root of rounding, 10^-7.
    np.testing.assert_allclose([u[0], v[0]], best.x, atol=1e-6)


def whole_guess(n: int, u: float, v: float) -> np.ndarray:
    guess = np.zeros((n, 6))
    guess[:, 0], guess[:, 3] = u, v
    return guess


def points(first: int, last: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = (v.ravel().astype(np.int64) for v in np.mgrid[first:last:step, first:last:step])
    return x, y


@pytest.fixture(scope="module")
def pattern(speckle):
    return speckle.random(6, SIZE, width=1.5)


def test_whole_pixels_are_found_exactly_from_a_poor_guess(pattern) -> None:
    reference, deformed = pattern.image(SIZE), pattern.image(SIZE, lambda x, y: (x - 4.0, y + 3.0))
    images = prepare_images(reference, deformed, np.ones((SIZE, SIZE), np.int32))
    x, y = points(20, 76, 8)
    found = match_by_cross_correlation(images, x, y, whole_guess(len(x), 2.0, -1.0), MatchSettings(10))
    assert (found.ending == correlation.CONVERGED).all()
    # Two sub-images that are the same have their peak at no shift, to the tolerance.
    np.testing.assert_allclose(found.warp[:, [0, 3]], np.tile([4.0, -3.0], (len(x), 1)), atol=5e-4)
    assert found.score.min() > 0.9999


@pytest.mark.parametrize("radius", [8, 14])
def test_the_pull_towards_whole_pixels_is_stated(pattern, radius: int) -> None:
    shift = np.array([0.3, -0.4])
    reference, deformed = pattern.image(SIZE), pattern.image(SIZE, lambda x, y: (x - shift[0], y - shift[1]))
    images = prepare_images(reference, deformed, np.ones((SIZE, SIZE), np.int32))
    x, y = points(20, 76, 4)
    settings = MatchSettings(radius)
    found = match_by_cross_correlation(images, x, y, whole_guess(len(x), 0.0, 0.0), settings)
    assert (found.ending == correlation.CONVERGED).all()
    error = found.warp[:, [0, 3]] - shift
    # Towards zero, by the part of the peak's curvature that the rims make.
    assert (error.mean(axis=0) * shift < 0.0).all()
    assert 0.7 < np.sqrt(np.mean(found.sigma**2) / np.mean(error**2)) < 1.3
    default = match_points(images, x, y, whole_guess(len(x), 0.0, 0.0), settings).warp[:, [0, 3]] - shift
    # The default knows no such pull: what it is off by is the spline, 10^-3 px.
    assert np.abs(default).max() < 2e-3 < 0.02 < np.abs(error).mean()


def test_regions_keep_the_halves_apart(pattern) -> None:
    above, below = (pattern.image(SIZE, lambda x, y, u=u: (x - u, y)) for u in (2.0, -3.0))
    labels = np.ones((SIZE, SIZE), np.int32)
    labels[SIZE // 2 :] = 2
    deformed = np.where(labels == 1, above, below)
    x = np.arange(20, 76, 4)
    y = np.full(len(x), SIZE // 2 - 1)
    guess = whole_guess(len(x), 1.0, 0.0)
    parted = match_by_cross_correlation(
        prepare_images(pattern.image(SIZE), deformed, labels), x, y, guess, MatchSettings(10)
    )
    assert (parted.ending == correlation.CONVERGED).all()
    np.testing.assert_allclose(parted.warp[:, 0], 2.0, atol=5e-4)
    plain = match_by_cross_correlation(
        prepare_images(pattern.image(SIZE), deformed, np.ones_like(labels)), x, y, guess, MatchSettings(10)
    )
    # Half of each sub-image is foreign: two peaks, and neither is where it should be in all places.
    assert np.abs(plain.warp[:, 0] - 2.0).max() > 0.1


def test_what_cannot_be_matched_has_its_reason(pattern) -> None:
    reference = pattern.image(SIZE)
    reference[40:80, 40:80] = 3000.0
    labels = np.ones((SIZE, SIZE), np.int32)
    labels[:8, :8] = 2
    images = prepare_images(reference, reference, labels, (Noise(1.0, 0.0),) * 2)
    x, y = np.array([3, 60, 90, 20]), np.array([3, 60, 20, 20])
    guess = whole_guess(4, 0.0, 0.0)
    guess[2, 0] = 40.0
    found = match_by_cross_correlation(images, x, y, guess, MatchSettings(10, minimum_part=0.3))
    np.testing.assert_array_equal(
        found.ending,
        [correlation.TOO_FEW_PIXELS, correlation.NO_TEXTURE, correlation.LEFT_IMAGE, correlation.CONVERGED],
    )
    assert np.isfinite(found.sigma[3]).all()
    assert np.isnan(found.sigma[:3]).all()


def test_threads_do_not_matter(pattern) -> None:
    reference, deformed = pattern.image(SIZE), pattern.image(SIZE, lambda x, y: (x - 0.3, y))
    images = prepare_images(reference, deformed, np.ones((SIZE, SIZE), np.int32))
    x, y = points(12, 84, 4)
    one, two = (
        match_by_cross_correlation(images, x, y, whole_guess(len(x), 0.0, 0.0), MatchSettings(8), threads=n)
        for n in (1, 2)
    )
    for a, b in zip(vars(one).values(), vars(two).values(), strict=True):
        np.testing.assert_array_equal(a, b)
