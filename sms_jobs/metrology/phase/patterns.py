"""The fringe patterns that a projector shows, and where in the projector a phase gradient lies.

The coordinate along an orientation is counted in projector pixels from the middle of the projector's
image, and the phase gradient omega runs from -pi to pi over its span, so that t fringes have the phase
omega t (see docs/conventions.md).
"""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import pixel_grid


def direction(orientation_rad: float) -> tuple[float, float]:
    """Return (cos, sin) of a fringe orientation, exact zeros where the orientation is along an axis."""
    along = (cos(orientation_rad), sin(orientation_rad))
    return (0.0 if abs(along[0]) < 1e-15 else along[0], 0.0 if abs(along[1]) < 1e-15 else along[1])


def span_px(columns: int, rows: int, orientation_rad: float) -> float:
    """Return N, the length in pixels over which omega grows from -pi to pi along an orientation."""
    a, b = direction(orientation_rad)
    return columns * abs(a) + rows * abs(b)


def phase_gradient(pixels: Floats, columns: int, rows: int, orientation_rad: float) -> Floats:
    """Return the phase gradient omega at projector pixels.

    Parameters
    ----------
    pixels
        (..., 2), projector pixel coordinates (x, y), sub-pixel.
    columns, rows
        Size of the projector's image, in pixels.
    orientation_rad
        Direction in which the phase grows.

    Returns
    -------
    (...), in rad per fringe.

    Notes
    -----
    omega = 2 pi (x + 0.5 - N/2) / N for orientation 0: thesis Eq. (1.16), with the half pixel that puts
    omega = 0 at the middle of the image when pixel 0 is the centre of the first pixel.
    """
    a, b = direction(orientation_rad)
    x = pixels[..., 0] + 0.5 - columns / 2.0
    y = pixels[..., 1] + 0.5 - rows / 2.0
    return np.asarray((a * x + b * y) * (2.0 * pi / span_px(columns, rows, orientation_rad)))


def fringe_intensity(omega: Floats, density: float, step: int, steps: int, visibility: float = 1.0) -> Floats:
    """Return the brightness of a fringe pattern, 0 .. 1 of the projector's full brightness.

    Parameters
    ----------
    omega
        (...), phase gradient in rad.
    density
        Number of fringes t across the projector.
    step, steps
        Phase step k = 0 .. q-1, and their number q.
    visibility
        V, 0 .. 1.

    Notes
    -----
    (1 + V cos(omega t + 2 pi k / q)) / 2: thesis Eq. (1.16) with I_0 = 1/2 and k counted from 0.
    """
    return np.asarray(0.5 * (1.0 + visibility * np.cos(omega * density + 2.0 * pi * step / steps)))


def fringe_pattern(
    columns: int, rows: int, orientation_rad: float, density: float, step: int, steps: int
) -> Floats:
    """Return a whole pattern as the projector shows it, (rows, columns), brightness 0 .. 1."""
    omega = phase_gradient(pixel_grid(rows, columns), columns, rows, orientation_rad)
    return fringe_intensity(omega, density, step, steps)


def stripe_brightness(omega: Floats, bits: int, stripes: float, bit: int | None, inverted: bool) -> Floats:
    """Return the brightness of a pattern of a Gray code, 0 or 1 of the projector's full brightness.

    Parameters
    ----------
    omega
        (...), phase gradient in rad.
    bits, stripes
        Patterns of the code, and how many stripes go across the projector.
    bit
        Which pattern, 0 the coarsest; None for a uniform field.
    inverted
        Whether bright and dark are exchanged.

    Notes
    -----
    Bright where the bit of stripe xor stripe / 2 is set, with stripe = floor((omega / 2 pi + 1/2) stripes).
    """
    if bit is None:
        return np.full(omega.shape, 0.0 if inverted else 1.0)
    number = np.clip(np.floor((omega / (2.0 * pi) + 0.5) * stripes), 0, 2**bits - 1).astype(np.int64)
    bright = ((number ^ (number >> 1)) >> (bits - 1 - bit)) & 1 == 1
    return np.asarray(bright != inverted, np.float64)


def fringe_harmonics(
    density: float, span: float, *, visibility: float = 1.0, gamma: float = 1.0, defocus_px: float = 0.0
) -> Floats:
    """Return the Fourier cosine coefficients c_n of a pattern as an imperfect projector shows it.

    Parameters
    ----------
    density
        Number of fringes t across `span`.
    span
        N in projector pixels, see `span_px`.
    visibility
        V of the pattern that is sent to the projector.
    gamma
        Exponent of the projector's response: brightness = sent^gamma.
    defocus_px
        Standard deviation of its Gaussian defocus, in projector pixels.

    Returns
    -------
    (n,): the brightness is the sum over n of c_n cos(n phi). A linear projector has two coefficients.

    Notes
    -----
    A Gaussian of standard deviation s damps the frequency f by exp(-2 pi^2 s^2 f^2); f = n t / N. The
    powers of the raised cosine are expanded numerically; harmonics below 1e-7 are left out.
    """
    samples = 512
    sent = 0.5 * (1.0 + visibility * np.cos(2.0 * pi * np.arange(samples) / samples))
    spectrum = np.fft.rfft(sent**gamma).real / samples
    spectrum[1:] *= 2.0
    n = np.arange(spectrum.size)
    spectrum *= np.exp(-2.0 * (pi * defocus_px * n * density / span) ** 2)
    kept = np.flatnonzero(np.abs(spectrum) > 1e-7)
    return np.asarray(spectrum[: max(int(kept[-1]) + 1, 2)])
