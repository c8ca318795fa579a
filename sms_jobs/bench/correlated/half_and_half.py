"""The half-and-half subset of thesis Fig. 35-37: two halves of an image that move by different amounts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.bench.correlated.speckle_pairs import Pattern, halves
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    MatchSettings,
    Noise,
    prepare_images,
)
from sms_jobs.metrology.deformation.matching.grid import REFINEMENT, Method

HALVES = tuple((0.2 * k, 0.4 * k) for k in range(1, 9))
"""Displacements along x of the upper and of the lower half, in px, as in thesis Fig. 37."""

_SIZE, _REACH = 128, 24  # px: of the image, and of the rows about the edge that are looked at


@dataclass(frozen=True)
class AboutEdge:
    """Errors of points about an edge between two rows.

    Attributes
    ----------
    shifts
        (shifts, 2), displacements of the upper and of the lower half, in px.
    distance
        (rows,), of a row's middle from the edge, in px; negative above it.
    own_part
        (rows,), part of the subset that lies on its centre's half.
    error, sigma
        (shifts, rows, points), of u, and what is stated of it, in px; NaN where a match failed.
    """

    shifts: Floats
    distance: Floats
    own_part: Floats
    error: Floats
    sigma: Floats

    def folded(self) -> AboutEdge:
        """Return both sides of the edge together, 0.5, 1.5 .. px from it."""
        half = len(self.distance) // 2
        error, sigma = (
            np.concatenate([both[:, half - 1 :: -1], both[:, half:]], axis=2)
            for both in (self.error, self.sigma)
        )
        return AboutEdge(self.shifts, self.distance[half:], self.own_part[half:], error, sigma)

    def rms(self) -> Floats:
        """Return the rms error (rows,) of the matches that ended well, in px; NaN where there is none."""
        known = np.isfinite(self.error)
        count = known.sum(axis=(0, 2))
        squares = np.where(known, self.error, 0.0) ** 2
        return np.where(count > 0, np.sqrt(squares.sum(axis=(0, 2)) / np.maximum(count, 1)), np.nan)

    def found(self) -> Floats:
        """Return the part (rows,) of the points whose matches ended well."""
        return np.asarray(np.isfinite(self.error).mean(axis=(0, 2)))


def match_halves(
    *,
    parted: bool,
    method: Method = "gauss-newton",
    radius: int = 16,
    noise: float = 0.0,
    shifts: tuple[tuple[float, float], ...] = HALVES,
    pattern: Pattern = "blobs",
) -> AboutEdge:
    """Match subsets on and about the edge between the halves of exact speckle.

    Parameters
    ----------
    parted
        Whether each half is a region of its own, or both are matched as one.
    method
        How a point is matched; its first guess is its own half's displacement to whole pixels.
    radius
        Of the subsets, in px.
    noise
        Standard deviation of both images, in parts of the speckle's contrast.
    shifts
        Of the upper and the lower half, in px.
    pattern
        Of the speckle.
    """
    middle = _SIZE // 2
    y, x = (a.ravel() for a in np.mgrid[middle - _REACH : middle + _REACH, 24 : _SIZE - 24 : 4])
    error, sigma = np.full((2, len(shifts), len(x)), np.nan)
    for k, (upper, lower) in enumerate(shifts):
        reference, deformed, labels = halves(_SIZE, upper, lower, 40 + k, pattern)
        rng = np.random.default_rng(140 + k)
        level = noise * reference.std()
        first, second = (image + rng.normal(0.0, level, image.shape) for image in (reference, deformed))
        model = Noise(level**2, 0.0)
        images = prepare_images(first, second, labels if parted else np.ones_like(labels), (model, model))
        truth = np.where(y < middle, upper, lower)
        guess = np.zeros((len(x), 6))
        guess[:, 0] = np.rint(truth)
        found = REFINEMENT[method](images, x, y, guess, MatchSettings(radius))
        good = found.ending == CONVERGED
        error[k, good] = (found.warp[:, 0] - truth)[good]
        sigma[k, good] = found.sigma[good, 0]
    distance = np.arange(-_REACH, _REACH, dtype=np.float64) + 0.5
    return AboutEdge(
        np.array(shifts),
        distance,
        np.asarray(np.minimum((np.abs(distance) + radius + 0.5) / (2 * radius + 1), 1.0)),
        error.reshape(len(shifts), 2 * _REACH, -1),
        sigma.reshape(len(shifts), 2 * _REACH, -1),
    )
