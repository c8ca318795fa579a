"""Laser speckle: the light of a rough surface behind a round aperture (thesis section 4.3.3).

Its statistics are those of fully developed speckle: a negative exponential histogram, and an autocorrelation
that the aperture alone determines. It has no detail finer than the aperture passes, and is therefore known
exactly between its pixels too.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats

WIDTH_TIMES_APERTURE = 0.514497
"""Full width at half maximum of the autocorrelation of the brightness, in px, times the aperture's radius in
cycles a pixel: (2 J1(x) / x)^2 is a half at x = 1.616340, and the width is x / pi over the radius."""

_FINEST = 0.25  # cycles a pixel: the brightness has twice the frequencies of the amplitude
_ROWS_AT_ONCE = 256


@dataclass(frozen=True)
class LaserSpeckle:
    """A pattern of laser speckle.

    Attributes
    ----------
    aperture
        Radius of the aperture in cycles a pixel, r0 / N of the thesis: speckles are 0.51 / aperture px wide.
    seed
        Of the pattern.
    roughness_um, wavelength_um
        Standard deviation of the surface's height, and wavelength of the light.
    """

    aperture: float
    seed: int
    roughness_um: float = 20.0
    wavelength_um: float = 0.532


@dataclass(frozen=True)
class Aperture:
    """The light in an aperture, behind which there is an image of so many rows and columns.

    Attributes
    ----------
    amplitude
        (2 m + 1, 2 n + 1), complex: of the frequencies -m .. m over the rows and -n .. n over the columns.
    rows, columns
        Of the image.
    """

    amplitude: NDArray[np.complex128]
    rows: int
    columns: int

    def frequencies(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the frequencies over the rows and over the columns, in cycles an image."""
        m, n = (size // 2 for size in self.amplitude.shape)
        return np.arange(-m, m + 1), np.arange(-n, n + 1)


def rough_light(speckle: LaserSpeckle, rows: int, columns: int) -> Aperture:
    """Return the light that a rough surface sends through the aperture of an image (rows, columns).

    Thesis Eq. (3.18): exp(4 pi i sigma_z R / lambda) within the circle, 0 elsewhere; R are independent normal
    numbers of mean 0 and deviation 1. The circle is round in cycles a pixel, also where the image is not
    square.

    Raises `InvalidInput` for an aperture that passes no light but that of frequency 0, or more than the
    image's pixels can show, which is 0.25 cycles a pixel.
    """
    coarsest = 1.0 / min(rows, columns)
    if not coarsest <= speckle.aperture < _FINEST:
        raise InvalidInput(
            f"an aperture of {speckle.aperture:.3g} cycles a pixel makes no speckle in an image of "
            f"{columns} x {rows} px: choose {coarsest:.2g} or more, and less than {_FINEST:g}"
        )
    m, n = int(speckle.aperture * rows), int(speckle.aperture * columns)
    aperture = Aperture(np.zeros((2 * m + 1, 2 * n + 1), np.complex128), rows, columns)
    down, across = aperture.frequencies()
    inside = np.hypot(down[:, None] / rows, across / columns) <= speckle.aperture
    height = np.random.default_rng(speckle.seed).standard_normal(np.count_nonzero(inside))
    aperture.amplitude[inside] = np.exp(4j * pi * speckle.roughness_um / speckle.wavelength_um * height)
    return aperture


def laser_speckle(light: Aperture, u: float = 0.0, v: float = 0.0) -> Floats:
    """Return the image behind an aperture, displaced by (u, v) px: (rows, columns), of mean 1.

    I = |F^-1(S A)|^2 with S = exp(-2 pi i (u f_x + v f_y)), the frequencies f in cycles a pixel: thesis
    Eq. (3.19) and (3.20), corrected. Exact for any displacement, not only for whole pixels; what leaves the
    image on one side enters it on the other.

    Notes
    -----
    The thesis prints |F^-1(W S F(A))|^2. There the two transforms undo each other, and without W the image is
    the bright disc itself. A is what the aperture passes already: one transform is left, and the disc is the
    window W. The thesis also divides u x + v y by N in an image of 2 N - 1 pixels; S has the transform's own
    period here.
    """
    down, across = light.frequencies()
    turns = v / light.rows * down[:, None] + u / light.columns * across
    spread = np.zeros((light.rows, len(across)), np.complex128)
    spread[down] = light.amplitude * np.exp(-2j * pi * turns)
    # Unnormalised, by Parseval: the mean of |field|^2 is the sum of |A|^2.
    by_rows = np.fft.ifft(spread, axis=0, norm="forward")
    image = np.empty((light.rows, light.columns))
    for start in range(0, light.rows, _ROWS_AT_ONCE):
        slab = np.s_[start : start + _ROWS_AT_ONCE]
        wide = np.zeros((len(image[slab]), light.columns), np.complex128)
        wide[:, across] = by_rows[slab]
        field = np.fft.ifft(wide, axis=1, norm="forward")
        image[slab] = field.real**2 + field.imag**2
    return np.asarray(image / np.sum(np.abs(light.amplitude) ** 2))
