"""The error that a surface's texture makes where two cameras see one fringe pattern, and its correction.

Each camera's light comes from beside the middle of its pixels where the texture is brighter there, see
`metrology.phase.texture_error`. Both see one texture: what they make of it cancels as far as their spots and
their views of the surface are alike, so that the gaps between their rays tell little of either spot. Its own
phases tell each camera's: they would be smooth without the texture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.phase.seen_texture import Floating, SeenTexture, Shift
from sms_jobs.metrology.phase.texture_error import (
    LARGEST_BLUR,
    PRECISION,
    ROUNDS,
    SETTLED,
    TAILS,
    TEXTURE_ROUNDS,
    TRIM,
    UNKNOWN,
    Blur,
    roughness_told,
    textured_interior,
)

UNKNOWN_ROUGH_PX = UNKNOWN.rough_px
"""Of cameras whose images do not tell."""
_REACH = 3
_FLAT, _, _BEND = np.linalg.qr(np.vander(np.arange(-_REACH, _REACH + 1.0), 3, increasing=True))[0].T
"""Orthonormal polynomials over seven pixels."""
_MODEL_SIGMA = 0.02
"""px^2 that the spot of a camera is off a Gaussian's, as what pixels show of textures tells it; by trial."""


@dataclass(frozen=True)
class Spots:
    """The spots through which the pixels of two cameras collect light.

    Attributes
    ----------
    variance, sigma
        (2,), s^2 of both, the pixel's own area included, and its standard deviation, in px^2.
    rough_px
        By how much light is off where the roughness of the modulation is 1, as a standard deviation in px.
    """

    variance: Floats
    sigma: Floats
    rough_px: float = UNKNOWN_ROUGH_PX

    @property
    def mean(self) -> Blur:
        """What both are in the mean, which is what a bend of the surface is moved by."""
        return Blur(float(self.variance.mean()), 0.5 * float(np.hypot(*self.sigma)), self.rough_px)

    def largest(self, which: int) -> float:
        """Return the s^2 of a camera, in px^2, that is a standard deviation above what is likely."""
        return float(self.variance[which] + self.sigma[which])

    def left(self, shifts: tuple[Floats, Floats], spreads: tuple[Singles, Singles]) -> Singles:
        """Return the standard deviation that is left of texture in what the phases of both differ by, in rad.

        `shifts` and `spreads` are those of `SeenTexture.shift`, at the same points.
        """
        told = np.hypot(*(sigma * shift for sigma, shift in zip(self.sigma, shifts, strict=True)))
        return np.asarray(np.hypot(told, self.rough_px * np.hypot(*spreads)), np.float32)


def estimate_spot(omega: Floats, sigma: Singles, texture: SeenTexture) -> tuple[float, float, Shift]:
    """Find the s^2 of a camera from its own phases, by trimmed weighted least squares.

    Parameters
    ----------
    omega, sigma
        (directions, rows, columns) in rad: phases and their standard deviations.
    texture
        What the camera sees of it.

    Returns
    -------
    s^2 and its standard deviation in px^2, and what `SeenTexture.shift` says of phases without its error.

    Notes
    -----
    The surface is smooth and the texture is not: what phases are off the parabola through the 7 x 7 px about
    them is s^2 times what their shifts are off theirs, and noise. `UNKNOWN` enters with its own uncertainty
    and decides where there is little texture or none.
    """
    telling = textured_interior(texture.usable, texture.gradient)
    weight = np.stack([1.0 / np.square(one[telling], dtype=np.float64) for one in sigma])
    known = np.where(texture.usable, omega, 0.0)
    off = np.stack([_off_parabola(one)[telling] for one in known])
    variance, deviation, shift = UNKNOWN.variance, UNKNOWN.variance_sigma, texture.shift(omega)
    for _ in range(TEXTURE_ROUNDS):
        before = variance
        shift = texture.shift(omega - variance * shift[0])
        slope = np.stack([_off_parabola(one)[telling] for one in shift[0]])
        rest = (off - variance * slope) * np.sqrt(weight)
        scale = max(1.0, float(np.median(np.abs(rest))) / 0.6745) if rest.size else 1.0
        kept = np.where(np.abs(rest) < TRIM * scale, weight, 0.0) / scale**2
        information = float(np.sum(kept * slope * slope))
        pull = float(np.sum(kept * slope * off))
        found = (pull + UNKNOWN.variance * PRECISION) / (information + PRECISION)
        variance = float(np.clip(found, 0.0, LARGEST_BLUR))
        deviation = float(np.hypot((information + PRECISION) ** -0.5, _MODEL_SIGMA))
        if abs(variance - before) <= SETTLED * variance:
            break
    return variance, deviation, shift


def _off_parabola(image: Floats) -> Floats:
    """Return how far pixels are off the parabola, by least squares, through the 7 x 7 px about each."""
    off = image.copy()
    for down, right in ((_FLAT, _FLAT), (_FLAT, _BEND), (_BEND, _FLAT)):  # the others are 0 in the middle
        along = ndimage.correlate1d(image, right, axis=1, mode="nearest")
        both = ndimage.correlate1d(along, down, axis=0, mode="nearest")
        off -= down[_REACH] * right[_REACH] * both
    return off


def estimate_rough(gap: Floating, gap_sigma: Floating, change: Floating, rough: Floating) -> float:
    """Find what pixels hide of the texture from the ray gaps that are left once it is corrected.

    Parameters
    ----------
    gap, gap_sigma
        (points,), gap and its standard deviation from noise, in px.
    change
        (points,), how the gap changes with the s^2 of a camera, in 1/px: where it hardly does, there is
        little texture.
    rough
        (points,), standard deviation of the gap for each px of `Spots.rough_px`.

    Notes
    -----
    As in `texture_error.estimate_blur`: what squares of gaps exceed noise by and grows with `rough`.
    """
    used = np.isfinite(gap) & np.isfinite(change) & np.isfinite(rough) & (gap_sigma > 0.0)
    square_gap, h = np.square(gap[used], dtype=np.float64), change[used].astype(float)
    noise, r = np.square(gap_sigma[used].astype(float)), np.square(rough[used].astype(float))
    square = UNKNOWN.rough_px**2
    for _ in range(ROUNDS):
        w = 1.0 / (noise + square * r)
        rest = np.sqrt(square_gap * w)
        scale = max(1.0, float(np.median(rest)) / 0.6745) if rest.size else 1.0
        near = rest < TAILS * scale
        information = float(np.sum(w * h * h)) / scale**2
        share = information / (information + PRECISION)
        part = roughness_told(square_gap[near] - noise[near], r[near], w[near])
        square = share * part + (1.0 - share) * UNKNOWN.rough_px**2
    return float(np.sqrt(square))
