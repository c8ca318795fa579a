"""Laser speckle has the statistics that theory demands of it, and moves by any displacement without error."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.images.texture_quality import speckle_width
from sms_jobs.virtual_rig.laser_speckle import WIDTH_TIMES_APERTURE, LaserSpeckle, laser_speckle, rough_light

N = 256
THESIS = 1.0 / 16.0  # r0 / N of thesis section 4.3.3
SEEDS = 40


def coherence() -> Floats:
    """Return abs(mu)^2 at every cyclic lag, the autocorrelation that the aperture's own transform demands."""
    amplitude = np.zeros((N, N))
    f = np.rint(np.fft.fftfreq(N) * N)
    amplitude[np.hypot(f[:, None], f) <= THESIS * N] = 1.0
    mu = np.fft.ifft2(amplitude) / np.fft.ifft2(amplitude)[0, 0]
    return np.asarray(np.abs(mu) ** 2)


@pytest.fixture(scope="module")
def images() -> Floats:
    return np.array([laser_speckle(rough_light(LaserSpeckle(THESIS, seed), N, N)) for seed in range(SEEDS)])


def test_speckle_is_fully_developed(images: Floats) -> None:
    np.testing.assert_allclose(images.mean(axis=(1, 2)), 1.0, rtol=1e-12)
    points = np.count_nonzero(rough_light(LaserSpeckle(THESIS, 0), N, N).amplitude)
    assert points == pytest.approx(pi * (THESIS * N) ** 2, rel=0.02)
    # Contrast 1: the variance of the sum of n waves of amplitude 1 and any phase is 1 - 1 / n. Of bivariate
    # exponential intensities at a fixed mean, that of an image's own variance is 4 sum abs(mu)^4 / pixels.
    scatter = np.sqrt(4.0 * np.sum(coherence() ** 2) / N**2)
    found = images.var(axis=(1, 2))
    assert found.mean() == pytest.approx(1.0 - 1.0 / points, abs=4.0 * scatter / np.sqrt(SEEDS))
    # Forty draws tell a deviation to a ninth.
    assert found.std() == pytest.approx(scatter, rel=0.45)


@pytest.mark.parametrize("level", [0.1, 0.5, 1.0, 2.0, 4.0])
def test_brightness_has_a_negative_exponential_histogram(level: float, images: Floats) -> None:
    expected = np.exp(-level)
    # An image has no more independent speckles than sum abs(mu)^2 leaves: pixels over that.
    independent = SEEDS * N**2 / np.sum(coherence())
    scatter = np.sqrt(expected * (1.0 - expected) / independent)
    assert np.mean(images > level) == pytest.approx(expected, abs=4.0 * scatter)


def test_speckles_are_as_large_as_the_aperture_makes_them(images: Floats) -> None:
    spectrum = np.abs(np.fft.fft2(images - 1.0)) ** 2
    found = np.fft.ifft2(spectrum.mean(axis=0)).real / N**2
    independent = SEEDS * N**2 / np.sum(coherence())
    # At any lag the mean of products of exponential brightness scatters by 2 to 3 over that root at most.
    np.testing.assert_allclose(found, coherence(), atol=4.0 * 3.0 / np.sqrt(independent))
    widths = np.array([speckle_width(image, 0.0) for image in images])
    # 0.1 %: the circle of 797 whole frequencies for that of area pi r0^2, and straight lines between pixels.
    allowed = 4.0 * widths.std() / np.sqrt(SEEDS) + 1e-3 * widths.mean()
    assert widths.mean() == pytest.approx(WIDTH_TIMES_APERTURE / THESIS, abs=allowed)
    assert widths.std() < 0.05 * widths.mean()


def test_a_displaced_image_is_the_image_between_its_pixels() -> None:
    light = rough_light(LaserSpeckle(THESIS, 3), N, N)
    still, moved = laser_speckle(light), laser_speckle(light, 39.25, 14.19)
    np.testing.assert_allclose(
        laser_speckle(light, 39.0, -14.0), np.roll(still, (-14, 39), (0, 1)), rtol=1e-9
    )
    # The brightness holds frequencies up to 2 r0 = N / 8: its own Fourier series says what is between pixels.
    f = np.fft.fftfreq(N)
    between = np.fft.ifft2(np.fft.fft2(still) * np.exp(-2j * pi * (39.25 * f + 14.19 * f[:, None]))).real
    np.testing.assert_allclose(moved, between, atol=1e-11)
    # And the sum of all waves at one such place, written out.
    down, across = light.frequencies()
    x, y = 100 - 39.25, 60 - 14.19
    waves = light.amplitude * np.exp(2j * pi * (across * x + down[:, None] * y) / N)
    assert moved[60, 100] == pytest.approx(np.abs(waves.sum()) ** 2 / np.sum(np.abs(light.amplitude) ** 2))


def test_speckles_are_round_in_an_image_that_is_not_square() -> None:
    image = laser_speckle(rough_light(LaserSpeckle(THESIS, 5), 3 * N, N))
    assert image.shape == (3 * N, N)
    correlation = np.fft.ifft2(np.abs(np.fft.fft2(image - image.mean())) ** 2).real
    # Half the width, where it has fallen to a half, along both axes.
    half = round(0.5 * WIDTH_TIMES_APERTURE / THESIS)
    down, across = correlation[half, 0] / correlation[0, 0], correlation[0, half] / correlation[0, 0]
    assert down == pytest.approx(0.5, abs=0.1)
    assert across == pytest.approx(0.5, abs=0.1)


def test_a_smooth_surface_makes_no_speckle() -> None:
    # With heights of a thousandth of the wavelength all waves are in step: one bright point.
    light = rough_light(LaserSpeckle(THESIS, 1, roughness_um=0.0005), N, N)
    image = laser_speckle(light)
    assert image[0, 0] > 0.99 * np.count_nonzero(light.amplitude)


@pytest.mark.parametrize("aperture", [0.0, 0.003, 0.25, float("nan")])
def test_an_aperture_that_makes_no_speckle_is_refused(aperture: float) -> None:
    with pytest.raises(InvalidInput, match=r"cycles a pixel makes no speckle in an image of 256 x 300 px"):
        rough_light(LaserSpeckle(aperture, 1), 300, N)
