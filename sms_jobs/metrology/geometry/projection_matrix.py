"""The matrix of a pin-hole camera from points in space and their images."""

from __future__ import annotations

import numpy as np

from sms_jobs.errors import CalibrationFailed
from sms_jobs.metrology.arrays import Floats


def fit_projection(
    points: Floats, pixels: Floats, to_space: Floats, to_image: Floats, weight: Floats
) -> Floats:
    """Return the (3, 4) matrix P of the images P (X, 1) of points, whose third component is positive.

    Parameters
    ----------
    points
        (n, 3) in mm, six or more; not on a plane.
    pixels
        (n, 2), their images.
    to_space, to_image
        (4, 4) and (3, 3), affine: bring points and pixels to mean 0 and to a size of about 1.
    weight
        (n,), inverse standard deviations of the images.

    Raises
    ------
    CalibrationFailed
        For points of which some would be behind the camera.

    Notes
    -----
    Abdel-Aziz & Karara 1971 (thesis ref. 83), with the normalisation of Hartley 1997: the singular vector of
    the least singular value.
    """
    lifted = np.concatenate([points, np.ones((len(points), 1))], axis=1) @ to_space.T
    target = pixels @ to_image[:2, :2].T + to_image[:2, 2]
    zero = np.zeros_like(lifted)
    first = np.concatenate([lifted, zero, -target[:, :1] * lifted], axis=1)
    second = np.concatenate([zero, lifted, -target[:, 1:] * lifted], axis=1)
    rows = np.concatenate([first, second])
    depth = np.ones(len(points))
    for _ in range(3):  # reweighted, so that the residuals are those of the image
        _, _, v = np.linalg.svd(rows * np.tile(weight / depth, 2)[:, None], full_matrices=False)
        p = v[-1].reshape(3, 4)
        depth = lifted @ p[2]
        if depth.mean() < 0.0:
            p, depth = -p, -depth
        if depth.min() <= 0.0:
            raise CalibrationFailed(
                f"{int((depth <= 0.0).sum())} of {len(points)} points would be behind the sensor: "
                "points and images do not belong together"
            )
    return np.asarray(np.linalg.inv(to_image) @ p @ to_space)


def whitening(points: Floats) -> Floats:
    """Return the (d + 1, d + 1) affine matrix that brings points (n, d) to mean 0 and to size 1 on each axis.

    Points near a plane so keep a direction across it; along an axis without extent they stay as they are.
    """
    mean = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - mean, full_matrices=False)
    scale = np.sqrt(len(points)) / np.where(size > 1e-9 * size[0], size, size[0])
    d = len(mean)
    result = np.eye(d + 1)
    result[:d, :d] = scale[:, None] * axes
    result[:d, d] = -result[:d, :d] @ mean
    return result
