"""What a camera alone sees as a flat surface in pixels, for all that works on surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.planar import PlanarDisplacement
from sms_jobs.records.reasons import Reason

Floats = NDArray[np.float64]

_UU, _VV = 0, 3


@dataclass(frozen=True)
class Plane:
    """An image as a surface: x to the right, y up, in px.

    Attributes
    ----------
    xyz, displacement
        (3, rows, columns); the displacement is NaN where there is none.
    covariance
        (6, rows, columns) of the displacement.
    labels
        (rows, columns), 1 where there is a displacement, 0 elsewhere.
    """

    xyz: Floats
    displacement: Floats
    covariance: Floats
    labels: NDArray[np.int32]


def pixel_plane(shape: tuple[int, ...]) -> Floats:
    """Return the pixels as points of a plane, (3, rows, columns): x to the right, y up, in px."""
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    return np.stack([column, -row, np.zeros(shape)])


def as_surface(moved: PlanarDisplacement) -> Plane:
    """Return displacement in an image as that of a flat surface, which does not leave its plane."""
    u, v = moved.displacement
    valid = moved.reason == Reason.VALID
    covariance = np.zeros((6, *u.shape))
    covariance[[_UU, _VV]] = moved.sigma.astype(np.float64) ** 2
    covariance[:, ~valid] = np.nan
    return Plane(
        pixel_plane(u.shape),
        np.stack([u, -v, np.where(np.isfinite(u), 0.0, np.nan)]),
        covariance,
        valid.astype(np.int32),
    )
