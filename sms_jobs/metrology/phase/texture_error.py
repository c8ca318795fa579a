"""The error that a surface's texture makes in the phase gradient, and its correction.

A pixel collects light through a spot of finite size. Where the texture is brighter on one side of the
pixel, so is the spot's weight, and the phase is that of a point to that side: by s^2 grad(ln B) pixels for
a Gaussian spot of variance s^2, whatever the texture, because the spot's gradient is its first moment over
s^2. On a speckle pattern this exceeds the noise several times. The shift is known from the modulation B
itself; s^2 follows from the gaps between camera and projector rays, which it opens.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.geometry.triangulation import Triangulation

Floats = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floating = NDArray[np.floating]

_LARGEST_BLUR = 2.0  # px^2; a camera so far out of focus is not used for correlation
_PRECISION = 1.0 / 0.15**2  # of TYPICAL.variance, in 1/px^4
_TRIM = 4.0  # robust standard deviations
_ROUNDS = 4
_BLUR_ROWS = 128  # rows that are enough to estimate the blur from
_TEXTURE_ROUNDS = 2  # the first takes the slope of omega from phases that the texture still disturbs
_TEXTURED = 0.05  # 1/px: several times the noise of ln B, a twentieth of a speckle's edge


Meet: TypeAlias = Callable[[Floats, Single, int], Triangulation]
"""Triangulates phase gradients and their standard deviations that are of every n-th row."""


@dataclass(frozen=True)
class Blur:
    """The spot through which a pixel collects light.

    Attributes
    ----------
    variance
        s^2 in px^2, the pixel's own area included.
    unexplained
        Part of the correction, 0 .. 1, that is to be taken as its standard deviation.
    """

    variance: float
    unexplained: float


TYPICAL = Blur(1.0 / 3.0, 0.25)
"""Of a lens in focus: a spot of 0.5 px and the pixel's own 1/12 px^2."""


def log_gradient(brightness: Floating) -> Floats:
    """Return the gradient of ln(brightness) along columns and rows, (2, rows, columns) in 1/px.

    The derivative of the interpolating cubic spline: speckles of a few pixels have too much fine detail
    for central differences, which would leave twice the error.
    """
    image = np.asarray(brightness, dtype=np.float64)
    gradient = np.empty((2, *image.shape))
    for component, axis in enumerate((1, 0)):
        spline = ndimage.spline_filter1d(image, 3, axis=axis, mode="mirror")
        gradient[component] = ndimage.correlate1d(spline, [-0.5, 0.0, 0.5], axis=axis, mode="mirror")
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient /= image
    return np.nan_to_num(gradient, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


@kernel
def _difference(before: float, here: float, after: float) -> float:
    """Return the slope at a pixel from valid neighbours (NaN if not); the gentler side where they disagree.

    Across an edge of the surface one side's slope is the edge's.
    """
    back, forth = here - before, after - here
    if np.isnan(back):
        return 0.0 if np.isnan(forth) else forth
    if np.isnan(forth):
        return back
    if abs(forth - back) <= 0.5 * max(abs(forth), abs(back)):
        return 0.5 * (forth + back)
    return forth if abs(forth) < abs(back) else back


@kernel
def _shift_rows(omega: Floats, valid: Mask, gradient: Floats, start: int, stop: int, shift: Floats) -> None:
    rows, columns = valid.shape
    for row in range(start, stop):
        for column in range(columns):
            if not valid[row, column]:
                continue
            for axis in range(2):
                down, right = axis, 1 - axis
                r0, c0, r1, c1 = row - down, column - right, row + down, column + right
                has_before = r0 >= 0 and c0 >= 0 and valid[r0, c0]
                has_after = r1 < rows and c1 < columns and valid[r1, c1]
                for k in range(omega.shape[0]):
                    before = omega[k, r0, c0] if has_before else np.nan
                    after = omega[k, r1, c1] if has_after else np.nan
                    slope = _difference(before, omega[k, row, column], after)
                    shift[k, row, column] += slope * gradient[axis, row, column]


def texture_shift(omega: Floats, valid: Mask, gradient: Floats, threads: int = 1) -> Floats:
    """Return by how much the texture raises omega per unit of s^2: grad(omega) . grad(ln B).

    Parameters
    ----------
    omega
        (orientations, rows, columns) in rad.
    valid
        (rows, columns): whose omega can be used.
    gradient
        (2, rows, columns) in 1/px: `log_gradient` of the modulation.

    Returns
    -------
    (orientations, rows, columns) in rad/px^2; 0 where not valid.
    """
    shift = np.zeros_like(omega)
    in_row_blocks(
        lambda start, stop: _shift_rows(omega, valid, gradient, start, stop, shift), len(valid), threads
    )
    return shift


def textured_interior(valid: Mask, gradient: Floats, margin: int = 4) -> Mask:
    """Return the pixels that tell the blur: on texture, all pixels within `margin` px being valid.

    Beside edges the gap has other reasons and the spline still rings; without texture the gradient is
    noise, which would make the blur seem too small.
    """
    inside = ndimage.binary_erosion(valid, np.ones((1, 2 * margin + 1), dtype=bool))
    inside = ndimage.binary_erosion(inside, np.ones((2 * margin + 1, 1), dtype=bool))
    return np.asarray(inside & (np.hypot(gradient[0], gradient[1]) > _TEXTURED))


def _unexplained(excess: Floats, correction: Floats) -> float:
    """Return which part of the squared correction the squared gap exceeds its noise by.

    What it exceeds the noise by where the correction is least, in a fifth of the pixels, is not the
    texture's but the calibration's.
    """
    if correction.size == 0 or np.ptp(correction) == 0.0:
        return 0.0
    least = correction <= np.quantile(correction, 0.2)
    grown = np.mean(excess) - np.mean(excess[least])
    return float(np.clip(grown / (np.mean(correction) - np.mean(correction[least])), 0.0, 1.0))


def estimate_blur(gap: Floating, gap_sigma: Floating, change: Floating) -> Blur:
    """Find s^2 from the ray gaps that the texture opens, by trimmed weighted least squares.

    Parameters
    ----------
    gap, gap_sigma
        (points,), signed ray gap before the correction and its standard deviation from noise, in mm; of
        pixels of a `textured_interior`.
    change
        (points,), how the gap changes with s^2, in mm/px^2.

    Notes
    -----
    gap + s^2 change = noise. What remains of the gap's square beyond the noise and grows with that of the
    correction is the part `unexplained` of it; what does not grow is the calibration's. `TYPICAL` enters
    with its own uncertainty and decides where there is little texture or none.
    """
    used = np.isfinite(gap) & np.isfinite(change) & (gap_sigma > 0.0)
    g, h, w = gap[used].astype(float), change[used].astype(float), gap_sigma[used].astype(float) ** -2
    variance, scale, kept = TYPICAL.variance, 1.0, np.ones(g.size, dtype=bool)
    rest = (g + variance * h) * np.sqrt(w)
    for _ in range(_ROUNDS):
        scale = max(1.0, float(np.median(np.abs(rest))) / 0.6745) if rest.size else 1.0
        kept = np.abs(rest) < _TRIM * scale
        information = float(np.sum((w * h * h)[kept])) / scale**2
        pull = -float(np.sum((w * g * h)[kept])) / scale**2
        found = (pull + TYPICAL.variance * _PRECISION) / (information + _PRECISION)
        variance = float(np.clip(found, 0.0, _LARGEST_BLUR))
        rest = (g + variance * h) * np.sqrt(w)
    part = _unexplained(np.square(g + variance * h)[kept] - 1.0 / w[kept], np.square(variance * h[kept]))
    share = information / (information + _PRECISION)
    return Blur(variance, float(np.sqrt(share * part + (1.0 - share) * TYPICAL.unexplained**2)))


def correct_texture(
    omega: Floats,
    omega_sigma: Single,
    modulation: Single,
    usable: Mask,
    meet: Meet,
    *,
    blur_px: float | None = None,
    maximum_shift_px: float = np.inf,
    threads: int = 1,
) -> tuple[Blur, Mask]:
    """Take the texture's error out of omega, in place, and put what may be left of it into its sigma.

    Parameters
    ----------
    omega, omega_sigma
        (orientations, rows, columns) in rad.
    modulation
        (orientations, rows, columns), in grey levels.
    usable
        (rows, columns): whose omega can be used.
    meet
        Gives the ray gaps that tell the blur; not called for one orientation or with `blur_px`.
    blur_px
        Standard deviation of the spot, if it is known.
    maximum_shift_px
        How far off its centre a pixel's light may come from.

    Returns
    -------
    The blur, and the usable pixels whose light comes from farther off: they see past the edge of a surface
    or a shadow.
    """
    gradient = log_gradient(modulation.mean(axis=0))
    telling = textured_interior(usable, gradient)
    corrected = omega
    for _ in range(_TEXTURE_ROUNDS):
        shift = texture_shift(corrected, usable, gradient, threads)
        if blur_px is not None:
            blur = Blur(blur_px**2, TYPICAL.unexplained)
        else:
            blur = _blur_of_gaps(omega, omega_sigma, shift, telling, meet)
        corrected = omega - blur.variance * shift
    beside = usable & (blur.variance * np.hypot(gradient[0], gradient[1]) > maximum_shift_px)
    left = (blur.unexplained * blur.variance * shift).astype(np.float32)
    np.hypot(omega_sigma, left, out=omega_sigma)
    omega[...] = corrected
    return blur, beside


def _blur_of_gaps(omega: Floats, omega_sigma: Single, shift: Floats, telling: Mask, meet: Meet) -> Blur:
    """Return the blur that the ray gaps of some rows tell, or that is typical of a single orientation."""
    if len(omega) == 1:
        return TYPICAL
    every = max(len(telling) // _BLUR_ROWS, 1)
    part, sigma = omega[:, ::every].copy(), omega_sigma[:, ::every].copy()
    before, after = meet(part, sigma, every), meet(part - shift[:, ::every], sigma, every)
    seen = telling[::every]
    change = after.ray_gap - before.ray_gap
    return estimate_blur(before.ray_gap[seen], before.ray_gap_sigma[seen], change[seen])
