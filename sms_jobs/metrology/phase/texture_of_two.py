"""The error that a surface's texture makes where two cameras see one fringe pattern, and its correction.

Each camera's light comes from beside the middle of its pixels where the texture is brighter there, see
`metrology.phase.texture_error`. Both see one texture: what they make of it cancels as far as their spots and
their views of the surface are alike, and the gaps between their rays tell the rest. Neither spot is known
well from that, but the two together are, as far as points depend on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.phase.texture_error import (
    LARGEST_BLUR,
    PRECISION,
    ROUNDS,
    TAILS,
    TRIM,
    UNKNOWN,
    Blur,
    Floating,
    log_gradient,
    relative_gradient,
    roughness,
    roughness_told,
    texture_shift,
)


@dataclass(frozen=True)
class SeenTexture:
    """The texture in a camera's image.

    Attributes
    ----------
    gradient, relative
        (2, rows, columns) in 1/px, of `log_gradient` and `relative_gradient`.
    rough
        (2, rows, columns) of `roughness`.
    usable
        (rows, columns): whose omega can be used.
    threads
        How many threads to use; the result does not depend on it.
    """

    gradient: Floats
    relative: Floats
    rough: Floats
    usable: Mask
    threads: int

    @classmethod
    def of(cls, modulation: Singles, usable: Mask, lit: Mask, threads: int) -> SeenTexture:
        """Return that of the modulation (directions, rows, columns), which is known where it is `lit`."""
        brightness = modulation.mean(axis=0)
        return cls(
            log_gradient(brightness, lit),
            relative_gradient(brightness),
            roughness(brightness),
            usable,
            threads,
        )

    def shift(self, omega: Floats) -> tuple[Floats, Singles]:
        """Return what `texture_shift` does, of phases that the camera sees."""
        return texture_shift(omega, self.usable, self.gradient, self.rough, self.threads)

    def beside(self, variance: float, most_px: float) -> tuple[Mask, Mask]:
        """Return whose light comes from farther off than it may, and of which `relative` alone says so."""
        far, doubtful = (
            self.usable & (variance * np.hypot(slope[0], slope[1]) > most_px)
            for slope in (self.gradient, self.relative)
        )
        return far, doubtful


@dataclass(frozen=True)
class Spots:
    """The spots through which the pixels of two cameras collect light.

    Attributes
    ----------
    variance
        (2,), s^2 of both in px^2, the pixel's own area included.
    covariance
        (2, 2) of these, px^4.
    rough_px
        By how much light is off where the roughness of the modulation is 1, as a standard deviation in px.
    """

    variance: Floats
    covariance: Floats
    rough_px: float

    @classmethod
    def known(cls, blur_px: float) -> Spots:
        """Return those of cameras whose standard deviation is known in px; 0 where nothing is corrected."""
        return cls(np.full(2, blur_px**2), np.zeros((2, 2)), UNKNOWN.rough_px if blur_px else 0.0)

    @property
    def mean(self) -> Blur:
        """What both are in the mean, which is what a bend of the surface is moved by."""
        variance = float(np.sqrt(self.covariance.mean()))
        return Blur(float(self.variance.mean()), variance, self.rough_px)

    def largest(self, which: int) -> float:
        """Return the s^2 of a camera, in px^2, that is a standard deviation above what is likely."""
        return float(self.variance[which] + np.sqrt(self.covariance[which, which]))

    def left(self, shifts: tuple[Floats, Floats], spreads: tuple[Singles, Singles]) -> Singles:
        """Return the standard deviation that is left of texture in what the phases of both differ by, in rad.

        `shifts` and `spreads` are those of `SeenTexture.shift`, at the same points.
        """
        (own, other), square = shifts, self.covariance
        told = square[0, 0] * own**2 - 2.0 * square[0, 1] * own * other + square[1, 1] * other**2
        unseen = np.square(self.rough_px * np.hypot(*spreads))
        return np.asarray(np.sqrt(np.maximum(told, 0.0) + unseen), np.float32)


UNKNOWN_SPOTS = Spots(
    np.full(2, UNKNOWN.variance), np.diag(np.full(2, UNKNOWN.variance_sigma**2)), UNKNOWN.rough_px
)


def estimate_spots(
    gap: Floating, gap_sigma: Floating, change: Floating, rough: Floating, known_px: float | None = None
) -> Spots:
    """Find the s^2 of two cameras from the ray gaps that the texture opens, by trimmed least squares.

    Parameters
    ----------
    gap, gap_sigma
        (points,), signed gap without any correction and its standard deviation from noise, in px.
    change
        (2, points), how the gap changes with the s^2 of each, in 1/px.
    rough
        (points,), standard deviation of the gap for each px of `Spots.rough_px`.
    known_px
        Standard deviation of both spots, if it is known; then `rough_px` alone is found.

    Notes
    -----
    As `texture_error.estimate_blur`, with two unknowns: gap + s^2 . change = noise. `UNKNOWN_SPOTS` enters
    with its own uncertainty and decides what the gaps do not tell.
    """
    used = np.isfinite(gap) & np.isfinite(change).all(axis=0) & np.isfinite(rough) & (gap_sigma > 0.0)
    g, h = gap[used].astype(float), change[:, used].astype(float)
    noise, r = np.square(gap_sigma[used].astype(float)), np.square(rough[used].astype(float))
    before, precision = UNKNOWN_SPOTS.variance, np.eye(2) * PRECISION
    first = UNKNOWN_SPOTS if known_px is None else Spots.known(known_px)
    variance, covariance, square = first.variance, first.covariance, UNKNOWN.rough_px**2
    for _ in range(ROUNDS):
        w = 1.0 / (noise + square * r)
        rest = (g + variance @ h) * np.sqrt(w)
        scale = max(1.0, float(np.median(np.abs(rest))) / 0.6745) if rest.size else 1.0
        kept = np.where(np.abs(rest) < TRIM * scale, w, 0.0) / scale**2
        information = (h * kept) @ h.T
        told = np.linalg.inv(information + precision)
        if known_px is None:
            covariance = told
            variance = np.clip(told @ (precision @ before - (h * kept) @ g), 0.0, LARGEST_BLUR)
        near = np.abs(rest) < TAILS * scale
        share = float(np.trace(told @ information)) / 2.0
        part = roughness_told(np.square(g + variance @ h)[near] - noise[near], r[near], w[near])
        square = share * part + (1.0 - share) * UNKNOWN.rough_px**2
    return Spots(variance, covariance, float(np.sqrt(square)))
