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
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.geometry.triangulation import Triangulation
from sms_jobs.metrology.phase.seen_texture import Floating, SeenTexture

LARGEST_BLUR = 2.0  # px^2; a camera so far out of focus is not used for correlation
PRECISION = 1.0 / 0.25**2  # of UNKNOWN.variance, in 1/px^4
TRIM, TAILS = 4.0, 10.0  # robust standard deviations: of what tells s^2, and of what it leaves
_STRAIGHT = 1e-6  # part of its largest value below which the roughness does not vary
ROUNDS = 6
BLUR_ROWS = 128  # rows that are enough to estimate the blur from
TEXTURE_ROUNDS = 6  # each takes the slope of omega from phases that the texture disturbs less than before
SETTLED = 0.01  # part of s^2 by which it may still change: 0.005 px where light is off by half a pixel
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
    texture = SeenTexture.of(modulation, usable, lit, threads)
    if blur_px is not None or meet is None or len(omega) == 1:
        known = UNKNOWN if blur_px is None else Blur(blur_px**2, 0.0, UNKNOWN.rough_px if blur_px else 0.0)
        find_blur = _certain(known)
    else:
        find_blur = _told_by_gaps(omega, omega_sigma, textured_interior(usable, texture.gradient), meet)
    corrected, variance = omega.copy(), np.nan
    for _ in range(TEXTURE_ROUNDS):
        shift, spread = texture.shift(corrected)
        blur = find_blur(shift, spread)
        np.subtract(omega, np.multiply(blur.variance, shift, out=corrected), out=corrected)
        if abs(blur.variance - variance) <= SETTLED * blur.variance:
            break
        variance = blur.variance
    part = np.empty_like(omega_sigma)

    def state(start: int, stop: int) -> None:
        here = np.s_[:, start:stop]
        told, unseen = (blur.variance_sigma * shift[here]).astype(np.float32), np.float32(blur.rough_px)
        left = np.hypot(told, unseen * spread[here])
        np.hypot(omega_sigma[here], left, out=omega_sigma[here])
        with np.errstate(invalid="ignore", divide="ignore"):
            part[here] = np.nan_to_num(np.square(left / omega_sigma[here]), copy=False)
        omega[here] = corrected[here]

    in_row_blocks(state, len(usable), threads)
    # The other side of a blob at the border is not seen.
    part[:, [0, -1]] = part[:, :, [0, -1]] = 0.0
    return Corrected(blur, *texture.beside(blur.variance, maximum_shift_px), part)


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
