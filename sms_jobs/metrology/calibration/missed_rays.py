"""By how much a camera sees points beside the images of another's rays, all over an image.

Noise is different everywhere. What changes slowly over the image comes from the calibration, or from a camera
that has moved: of shifts and turns it is a plane, nearly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats

_FITS = 4
_FARTHEST_SIGMAS = 3.0
_FEWEST = 20.0
_CHANCE_SIGMAS = 2.0


@dataclass(frozen=True)
class MissedRays:
    """A plane through signed distances from the images of rays.

    Attributes
    ----------
    middle, size
        Mean and standard deviation of the places of the points in the reference camera's image, x and y, px.
    plane
        In px: at the middle, and how much more it is `size` further along x and along y.
    sigma
        Deviation of the rms of such a plane by noise alone, px.
    scatter
        Of the points about the plane, px.
    """

    middle: tuple[float, float]
    size: tuple[float, float]
    plane: tuple[float, float, float]
    sigma: float
    scatter: float

    @property
    def off_px(self) -> float:
        """Rms of the plane over the points, px."""
        return float(np.linalg.norm(self.plane))

    def change_px(self, before: MissedRays) -> float:
        """Return the rms change over where points were before, in px; 0 where noise explains it."""
        slopes = np.array(self.plane[1:]) / self.size
        moved = np.array(before.middle) - self.middle
        change = [
            self.plane[0] + slopes @ moved - before.plane[0],
            *(slopes * before.size - before.plane[1:]),
        ]
        found = float(np.linalg.norm(change))
        return found if found > _CHANCE_SIGMAS * np.hypot(self.sigma, before.sigma) else 0.0


def missed_rays(pixels: Floats, off: Floats, each: float) -> MissedRays | None:
    """Fit a plane to by how much points lie beside the images of their rays.

    Parameters
    ----------
    pixels
        (2, n), x and y in the reference camera's image, px.
    off
        (n,) in px, with a sign; NaN for unknown. What is farther off than three deviations does not count.
    each
        How many points have one error, as subsets that overlap have.

    Returns
    -------
    The plane, or None where fewer than 20 errors are known.

    Notes
    -----
    Least squares with three unknowns: where noise of deviation s makes all of it, the mean square of the
    plane over N independent points is 3 s^2 / N.
    """
    kept = np.isfinite(off)
    if kept.sum() < _FEWEST * each:
        return None
    middle, size = pixels[:, kept].mean(axis=1), np.maximum(pixels[:, kept].std(axis=1), 1.0)
    basis = np.stack([np.ones(len(off)), *(pixels - middle[:, None]) / size[:, None]])
    plane, scale = np.zeros(3), 0.0
    for _ in range(_FITS):
        plane = np.linalg.lstsq(basis[:, kept].T, off[kept])[0]
        left = np.abs(off - plane @ basis)
        scale = 1.4826 * float(np.median(left[kept]))
        kept = left <= _FARTHEST_SIGMAS * scale
        if kept.sum() < _FEWEST * each:
            return None
    return MissedRays(
        (float(middle[0]), float(middle[1])),
        (float(size[0]), float(size[1])),
        (float(plane[0]), float(plane[1]), float(plane[2])),
        scale * float(np.sqrt(3.0 * each / kept.sum())),
        scale,
    )
