"""A pin-hole camera for each view of a board: a homography of a plane, or a projection from space."""

from __future__ import annotations

from dataclasses import dataclass
from math import isinf

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.board_views import BoardView
from sms_jobs.metrology.calibration.starting.homography import fit_homography
from sms_jobs.metrology.geometry.projection_matrix import fit_projection, whitening

_ROUNDS = 3
_REFUSED_BEYOND = 8.0  # robust standard deviations, as of a homography
_FEWEST = 12
_RAYLEIGH_MEDIAN = 1.1774


@dataclass(frozen=True)
class ViewFit:
    """The matrix of a view, and what it was fitted to.

    Attributes
    ----------
    matrix
        (3, 3) from the plane of a flat board, or (3, 4) from the space of a wrapped one, in mm to px.
    kept
        (n,) which points it was fitted to.
    rms_px
        Root mean square of their residuals in the image, each coordinate.
    """

    matrix: Floats
    kept: Mask
    rms_px: float

    def planes(self) -> list[Floats]:
        """Return the homographies (3, 3) of the planes that the matrix tells: of space those of its axes.

        Each is of the plane of two axes through the origin, whose pixels obey what those of a board do.
        """
        if self.matrix.shape == (3, 3):
            return [self.matrix]
        return [self.matrix[:, [a, b, 3]] for a, b in ((0, 1), (1, 2), (0, 2))]


def fit_view(view: BoardView) -> ViewFit:
    """Fit a pin-hole camera to one view; outliers among its points are refused.

    Raises
    ------
    CalibrationFailed
        For too few points, or points that lie on a line or, about a cylinder, behind the camera.
    """
    if isinf(view.radius_mm):
        flat = fit_homography(view.point[:, :2], view.pixel, view.sigma_px)
        return ViewFit(flat.matrix, flat.kept, flat.rms_px)
    points = view.in_space
    kept = np.ones(len(points), np.bool_)
    for _ in range(_ROUNDS):
        if kept.sum() < _FEWEST:
            raise CalibrationFailed(
                f"{int(kept.sum())} points of a cylinder agree on where it is, and {_FEWEST} are needed"
            )
        matrix = fit_projection(
            points[kept],
            view.pixel[kept],
            whitening(points[kept]),
            whitening(view.pixel[kept]),
            1.0 / view.sigma_px[kept],
        )
        mapped = points @ matrix[:, :3].T + matrix[:, 3]
        off = mapped[:, :2] / mapped[:, 2:] - view.pixel
        distance = np.linalg.norm(off, axis=1) / view.sigma_px
        rms = float(np.sqrt(np.mean(off[kept] ** 2)))
        kept = distance <= _REFUSED_BEYOND * max(float(np.median(distance)) / _RAYLEIGH_MEDIAN, 1e-9)
    return ViewFit(matrix, kept, rms)
