"""Normals of a surface that is measured pixel by pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from sms_jobs.metrology.arrays import Floats


def image_normals(xyz: Floats, labels: NDArray[np.int32], half_width: int = 2) -> Floats:
    """Return the normals of a measured surface, towards the camera.

    Parameters
    ----------
    xyz
        (3, rows, columns) in mm.
    labels
        (rows, columns), region of each pixel; 0 is no surface.
    half_width
        Positions are averaged over 2 p + 1 pixels each way before they are differenced over as many.

    Returns
    -------
    (3, rows, columns), of length 1; NaN where a neighbour of the same region is missing on both sides.

    Notes
    -----
    Rows point down and columns right, so the normal towards the camera is d/drow x d/dcolumn. Averages may
    reach over the rim of a region: these normals tell on which side of a part a point is, not its slope.
    """
    width = 2 * half_width + 1
    valid = (labels > 0) & np.isfinite(xyz).all(axis=0)
    share = uniform_filter(valid.astype(np.float64), width)
    smooth = np.full_like(xyz, np.nan)
    for axis in range(3):
        total = uniform_filter(np.where(valid, xyz[axis], 0.0), width)
        smooth[axis][valid] = total[valid] / share[valid]
    down = _difference(smooth, labels, half_width, 0)
    right = _difference(smooth, labels, half_width, 1)
    normal = np.cross(down, right, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(normal / np.linalg.norm(normal, axis=0))


def _difference(field: Floats, labels: NDArray[np.int32], step: int, axis: int) -> Floats:
    """Return the central difference over `step` pixels, or a one-sided one; NaN across regions."""
    low, here, high = (_shifted(field, labels, k, axis) for k in (-step, 0, step))
    both = high - low
    return np.where(
        np.isfinite(both), both, np.where(np.isfinite(high - here), 2.0 * (high - here), 2.0 * (here - low))
    )


def _shifted(field: Floats, labels: NDArray[np.int32], step: int, axis: int) -> Floats:
    """Return the field at the pixel `step` further along an axis of the image, NaN in another region."""
    found = np.full_like(field, np.nan)
    source, target = [slice(None), slice(None)], [slice(None), slice(None)]
    source[axis] = slice(max(step, 0), labels.shape[axis] + min(step, 0))
    target[axis] = slice(max(-step, 0), labels.shape[axis] + min(-step, 0))
    same = labels[tuple(source)] == labels[tuple(target)]
    found[(slice(None), *target)] = np.where(same, field[(slice(None), *source)], np.nan)
    return found
