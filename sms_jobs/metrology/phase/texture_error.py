"""The error that a surface's texture makes in the phase gradient, and its correction.

A pixel collects light through a spot of finite size. Where the texture is brighter on one side of the
pixel, so is the spot's weight, and the phase is that of a point to that side: by s^2 grad(ln B) pixels for
a Gaussian spot of variance s^2, whatever the texture, because the spot's gradient is its first moment over
s^2. On a speckle pattern this exceeds the noise several times. The shift is known from the modulation B
itself; s^2 follows from the gaps between camera and projector rays, which it opens.

What the pixels do not show of the texture remains: an edge inside a pixel moves its light by up to an
eighth of a pixel, and by a twelfth in the mean. How much of it there is shows in how much B changes over
three pixels, its roughness, and what a unit of that is worth follows from the gaps as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel
from sms_jobs.metrology.geometry.triangulation import Triangulation
from sms_jobs.metrology.images.masks import at_edge

Floating = NDArray[np.floating]

LARGEST_BLUR = 2.0  # px^2; a camera so far out of focus is not used for correlation
PRECISION = 1.0 / 0.25**2  # of UNKNOWN.variance, in 1/px^4
TRIM, TAILS = 4.0, 10.0  # robust standard deviations: of what tells s^2, and of what it leaves
_STRAIGHT = 1e-6  # part of its largest value below which the roughness does not vary
ROUNDS = 6
_FILLED_FROM = (5, 5)  # px about a pixel that is not lit
_RINGING_PX = (9, 9)  # about one: what a cubic spline makes of a bend falls to 0.27 a pixel, 0.005 in four
BLUR_ROWS = 128  # rows that are enough to estimate the blur from
TEXTURE_ROUNDS = 6  # each takes the slope of omega from phases that the texture disturbs less than before
SETTLED = 0.01  # part of s^2 by which it may still change: 0.005 px where light is off by half a pixel
_OUTERMOST = 5.0  # in focus s^2 is some five times rough_px, and across the border nothing is corrected
_SMALLEST_GAP = 4  # px; fewer that fail are no edge but noise
_TEXTURED = 0.02  # 1/px: several times the noise of ln B, a fiftieth of a speckle's edge


Meet: TypeAlias = Callable[[Floats, Singles, int], Triangulation]
"""Triangulates phase gradients and their standard deviations that are of every n-th row."""


@dataclass(frozen=True)
class Blur:
    """The spot through which a pixel collects light.

    Attributes
    ----------
    variance, variance_sigma
        s^2 in px^2, the pixel's own area included, and its standard deviation.
    rough_px
        By how much light is off where the roughness of the modulation is 1, as a standard deviation in px.
    """

    variance: float
    variance_sigma: float
    rough_px: float


UNKNOWN = Blur(1.0 / 12.0, 0.25, 0.15)
"""Of a camera whose images do not tell: the pixel's own area, uncertain by a lens's spot of 0.5 px."""


FindBlur: TypeAlias = Callable[[Floats, Singles], Blur]
"""Tells the blur from what `texture_shift` returns."""


def log_gradient(brightness: Floating, lit: Mask) -> Floats:
    """Return the gradient of ln(brightness) along columns and rows, (2, rows, columns) in 1/px.

    Of the logarithm's spline: that of the brightness itself rings beside a bright place by more than a dark
    one has. Near what is not `lit` (rows, columns), since darkness has no logarithm, of the brightness all
    the same. The outermost pixels of the image, where a spline would have to know what lies beyond, have no
    gradient across the border.
    """
    import cv2

    image = np.asarray(brightness, dtype=np.float64)
    lit = lit & (image > 0.0)
    rim = at_edge(lit, _SMALLEST_GAP)
    gradient = _spline_gradient(_logarithm(image, lit & ~rim))
    near = cv2.dilate(rim.astype(np.uint8), np.ones(_RINGING_PX, np.uint8)).astype(bool)
    gradient[:, near] = relative_gradient(image)[:, near]
    return gradient


def relative_gradient(brightness: Floating) -> Floats:
    """Return the gradient of the brightness over the brightness, (2, rows, columns) in 1/px; 0 in darkness.

    As `log_gradient` returns it, but of the spline of the brightness, which needs no logarithm: of smooth
    bodies before darkness, as spheres are.
    """
    image = np.asarray(brightness, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = _spline_gradient(image) / image
    return np.nan_to_num(gradient, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


def _logarithm(image: Floats, known: Mask) -> Floats:
    """Return ln(image); where it is not known, the mean of what is near, so that little rings."""
    import cv2

    if not known.any():
        return np.zeros_like(image)
    logarithm = np.log(np.where(known, image, 1.0))
    share, total = (
        cv2.blur(values, _FILLED_FROM, borderType=cv2.BORDER_REPLICATE)
        for values in (known.astype(np.float64), logarithm)
    )
    near = share > 1e-3  # less than one of 25 is none
    filled = np.where(near, total / np.where(near, share, 1.0), logarithm[known].mean())
    return np.where(known, logarithm, filled)


def _spline_gradient(image: Floats) -> Floats:
    """Return the derivatives of the interpolating cubic spline along columns and rows, (2, rows, columns).

    Speckles of a few pixels have too much fine detail for central differences, which would leave twice the
    error.
    """
    gradient = np.empty((2, *image.shape))
    for component, axis in enumerate((1, 0)):
        spline = ndimage.spline_filter1d(image, 3, axis=axis, mode="mirror")
        gradient[component] = ndimage.correlate1d(spline, [-0.5, 0.0, 0.5], axis=axis, mode="mirror")
    return gradient


def roughness(brightness: Floating) -> Floats:
    """Return how much the brightness changes within three pixels along columns and rows, (2, rows, columns).

    The length of its central first and its second difference, in units of the pixel's brightness: an edge in
    the middle of a pixel is all slope, one at its side half bend. The outermost pixels count more: they have
    no gradient.
    """
    image = np.asarray(brightness, dtype=np.float64)
    rough = np.empty((2, *image.shape))
    for component, axis in enumerate((1, 0)):
        slope, bend = (
            ndimage.correlate1d(image, weights, axis=axis, mode="nearest")
            for weights in ([-0.5, 0.0, 0.5], [1.0, -2.0, 1.0])
        )
        rough[component] = np.hypot(slope, bend)
        np.moveaxis(rough[component], axis, 0)[[0, -1]] *= _OUTERMOST
    with np.errstate(divide="ignore", invalid="ignore"):
        rough /= image
    return np.nan_to_num(rough, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


@inner
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
def _shift_rows(
    omega: Floats,
    valid: Mask,
    gradient: Floats,
    rough: Floats,
    start: int,
    stop: int,
    shift: Floats,
    spread: Singles,
) -> None:
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
                    unseen = slope * rough[axis, row, column]
                    spread[k, row, column] += unseen * unseen
            for k in range(omega.shape[0]):
                spread[k, row, column] = np.sqrt(spread[k, row, column])


def texture_shift(
    omega: Floats, valid: Mask, gradient: Floats, rough: Floats, threads: int = 1
) -> tuple[Floats, Singles]:
    """Return by how much the texture moves omega: per unit of s^2, and per px that light is off unseen.

    Parameters
    ----------
    omega
        (orientations, rows, columns) in rad.
    valid
        (rows, columns): whose omega can be used.
    gradient
        (2, rows, columns) in 1/px: `log_gradient` of the modulation.
    rough
        (2, rows, columns): `roughness` of the modulation.

    Returns
    -------
    grad(omega) . grad(ln B), (orientations, rows, columns) in rad/px^2; and the length of the vector with the
    components d(omega)/dx rough_x and d(omega)/dy rough_y, likewise in rad/px. 0 where not valid.
    """
    shift, spread = np.zeros_like(omega), np.zeros(omega.shape, np.float32)

    def work(start: int, stop: int) -> None:
        _shift_rows(omega, valid, gradient, rough, start, stop, shift, spread)

    in_row_blocks(work, len(valid), threads)
    return shift, spread


def textured_interior(valid: Mask, gradient: Floats, margin: int = 4) -> Mask:
    """Return the pixels that tell the blur: on texture, all pixels within `margin` px being valid.

    Beside edges the gap has other reasons and the spline still rings; without texture the gradient is
    noise, which would make the blur seem too small.
    """
    inside = ndimage.binary_erosion(valid, np.ones((1, 2 * margin + 1), dtype=bool))
    inside = ndimage.binary_erosion(inside, np.ones((2 * margin + 1, 1), dtype=bool))
    return np.asarray(inside & (np.hypot(gradient[0], gradient[1]) > _TEXTURED))


def roughness_told(excess: Floats, rough: Floats, weight: Floats) -> float:
    """Return how much the squared gap exceeds its noise by, for each unit of the squared `rough`.

    The slope of a straight line by weighted least squares, whose height at 0 is not the texture's but the
    calibration's, and not negative. With the square of the inverse variance as weight, as squares scatter,
    every pixel has its say, not the roughest alone.
    """
    share = np.square(weight)
    total, one, two = (float(np.sum(share * rough**n)) for n in range(3))
    height, slope = float(np.sum(share * excess)), float(np.sum(share * excess * rough))
    spread = total * two - one * one
    if not spread > _STRAIGHT * total * two:
        return 0.0
    beside = max((two * height - one * slope) / spread, 0.0)
    return float(np.clip((slope - beside * one) / two, 0.0, 1.0))


def estimate_blur(gap: Floating, gap_sigma: Floating, change: Floating, rough: Floating) -> Blur:
    """Find s^2 from the ray gaps that the texture opens, by trimmed weighted least squares.

    Parameters
    ----------
    gap, gap_sigma
        (points,), signed ray gap before the correction and its standard deviation from noise, in mm; of
        pixels of a `textured_interior`.
    change
        (points,), how the gap changes with s^2, in mm/px^2.
    rough
        (points,), standard deviation of the gap for each px of `Blur.rough_px`, in mm/px.

    Notes
    -----
    gap + s^2 change = noise, of the variance gap_sigma^2 + rough_px^2 rough^2: where the modulation is rough
    a gap tells little. What remains of the gap's square beyond the noise and grows with `rough` gives
    rough_px; what does not grow is the calibration's. `UNKNOWN` enters with its own uncertainty and decides
    where there is little texture or none.
    """
    used = np.isfinite(gap) & np.isfinite(change) & np.isfinite(rough) & (gap_sigma > 0.0)
    g, h = gap[used].astype(float), change[used].astype(float)
    noise, r = np.square(gap_sigma[used].astype(float)), np.square(rough[used].astype(float))
    variance, rough_square, information = UNKNOWN.variance, UNKNOWN.rough_px**2, 0.0
    for _ in range(ROUNDS):
        w = 1.0 / (noise + rough_square * r)
        rest = (g + variance * h) * np.sqrt(w)
        scale = max(1.0, float(np.median(np.abs(rest))) / 0.6745) if rest.size else 1.0
        kept = np.abs(rest) < TRIM * scale
        information = float(np.sum((w * h * h)[kept])) / scale**2
        pull = -float(np.sum((w * g * h)[kept])) / scale**2
        found = (pull + UNKNOWN.variance * PRECISION) / (information + PRECISION)
        variance = float(np.clip(found, 0.0, LARGEST_BLUR))
        share = information / (information + PRECISION)
        near = np.abs(rest) < TAILS * scale
        part = roughness_told(np.square(g + variance * h)[near] - noise[near], r[near], w[near])
        rough_square = share * part + (1.0 - share) * UNKNOWN.rough_px**2
    return Blur(variance, float((information + PRECISION) ** -0.5), float(np.sqrt(rough_square)))


@dataclass(frozen=True)
class Corrected:
    """What a correction for texture says.

    Attributes
    ----------
    blur
        As it was found.
    beside
        (rows, columns): the usable pixels whose light comes from farther off than it may. They see past the
        edge of a surface or a shadow, or are the rim of a dark speckle.
    doubtful
        (rows, columns): those of which the spline of the brightness alone says so. It rings in the dark; but
        a narrow shadow, which has no light of its own, it tells better than that of the logarithm.
    part
        (orientations, rows, columns): which part of the square of sigma is what may be left. That has no mean
        over a blob of texture, whose sides hide as much of either sign.
    """

    blur: Blur
    beside: Mask
    doubtful: Mask
    part: Singles

    def thinned(self, chosen: slice) -> Corrected:
        """Return it for some rows and columns, the blur in pixels that are as large as their distance."""
        step, blur = chosen.step, self.blur
        return Corrected(
            Blur(blur.variance / step**2, blur.variance_sigma / step**2, blur.rough_px / step),
            np.ascontiguousarray(self.beside[chosen, chosen]),
            np.ascontiguousarray(self.doubtful[chosen, chosen]),
            np.ascontiguousarray(self.part[:, chosen, chosen]),
        )


def correct_texture(
    omega: Floats,
    omega_sigma: Singles,
    modulation: Singles,
    usable: Mask,
    lit: Mask,
    meet: Meet | None,
    *,
    blur_px: float | None = None,
    maximum_shift_px: float = np.inf,
    threads: int = 1,
) -> Corrected:
    """Take the error of the texture out of omega, in place, and put what may be left into its sigma.

    Parameters
    ----------
    omega, omega_sigma
        (orientations, rows, columns) in rad.
    modulation
        (orientations, rows, columns), in grey levels.
    usable
        (rows, columns): whose omega can be used.
    lit
        (rows, columns): whose modulation is known, whatever their omega is.
    meet
        Gives the ray gaps that tell the blur; not called for one orientation or with `blur_px`. None where
        gaps do not tell it, as those of stripes, whose omega has steps: it is then `UNKNOWN`.
    blur_px
        Standard deviation of the spot, if it is known.
    maximum_shift_px
        How far off its centre a pixel's light may come from.
    """
    brightness = modulation.mean(axis=0)
    gradient, rough = log_gradient(brightness, lit), roughness(brightness)
    if blur_px is not None or meet is None or len(omega) == 1:
        known = UNKNOWN if blur_px is None else Blur(blur_px**2, 0.0, UNKNOWN.rough_px if blur_px else 0.0)
        find_blur = _certain(known)
    else:
        find_blur = _told_by_gaps(omega, omega_sigma, textured_interior(usable, gradient), meet)
    corrected, variance = omega, np.nan
    for _ in range(TEXTURE_ROUNDS):
        shift, spread = texture_shift(corrected, usable, gradient, rough, threads)
        blur = find_blur(shift, spread)
        corrected = omega - blur.variance * shift
        if abs(blur.variance - variance) <= SETTLED * blur.variance:
            break
        variance = blur.variance
    beside, doubtful = (
        usable & (blur.variance * np.hypot(slope[0], slope[1]) > maximum_shift_px)
        for slope in (gradient, relative_gradient(brightness))
    )
    left = np.hypot((blur.variance_sigma * shift).astype(np.float32), np.float32(blur.rough_px) * spread)
    np.hypot(omega_sigma, left, out=omega_sigma)
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.nan_to_num(np.square(left / omega_sigma), copy=False)
    # The other side of a blob at the border is not seen.
    part[:, [0, -1]] = part[:, :, [0, -1]] = 0.0
    omega[...] = corrected
    return Corrected(blur, beside, doubtful, part)


def _certain(blur: Blur) -> FindBlur:
    """Return what finds a blur that the gaps do not tell."""
    return lambda shift, spread: blur


def _told_by_gaps(omega: Floats, omega_sigma: Singles, telling: Mask, meet: Meet) -> FindBlur:
    """Return what finds the blur by the ray gaps of some rows, which are as they are before all rounds."""
    every = max(len(telling) // BLUR_ROWS, 1)
    part, seen = omega[:, ::every].copy(), telling[::every]
    before = meet(part, omega_sigma[:, ::every].copy(), every)

    def find(shift: Floats, spread: Singles) -> Blur:
        after = meet(part - shift[:, ::every], spread[:, ::every].copy(), every)
        return estimate_blur(
            before.ray_gap[seen],
            before.ray_gap_sigma[seen],
            (after.ray_gap - before.ray_gap)[seen],
            after.ray_gap_sigma[seen],
        )

    return find
