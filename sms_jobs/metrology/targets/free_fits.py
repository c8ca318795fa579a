"""Spheres and planes of which nothing is given, through all points of a set: what remains is form error.

Least squares in which each point counts the same, whatever its standard deviation: the form of a surface is
that of all its points. Deviations of the results come from the points' covariances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask

_STEPS = 50
_STILL = 1e-10  # of the radius, or of a unit vector
_TO_SIGMA = 1.4826
_OUTLIER = 4.0
"""Points farther from a plane, in robust standard deviations, do not belong to it."""


@dataclass(frozen=True)
class Form:
    """What remains of points about a feature.

    Attributes
    ----------
    span, span_sigma
        Largest less smallest signed distance, in mm, and its standard deviation: that of the two points.
    points
        How many took part.
    """

    span: float
    span_sigma: float
    points: int


@dataclass(frozen=True)
class FreeSphere:
    """A sphere through points.

    Attributes
    ----------
    centre, radius, radius_sigma
        In mm.
    form
        What remains along the radii.
    """

    centre: Floats
    radius: float
    radius_sigma: float
    form: Form


def fit_free_sphere(
    points: Floats, covariance: Floats, start: Floats, radius_mm: float, points_alike: float = 1.0
) -> FreeSphere:
    """Fit centre and radius of a sphere to all points, by Gauss and Newton.

    Parameters
    ----------
    points
        (n, 3) in mm.
    covariance
        (n, 3, 3) in mm^2.
    start, radius_mm
        (3,) and one number, near the sphere.
    points_alike
        How many neighbouring points share one error; 1 for errors that are independent.

    Raises
    ------
    InvalidInput
        The points do not hold a sphere.
    """
    unknown = np.append(np.asarray(start, dtype=np.float64), radius_mm)
    inverse = np.empty((4, 4))
    for _ in range(_STEPS):
        outwards = points - unknown[:3]
        length = np.linalg.norm(outwards, axis=1)
        normal = outwards / length[:, None]
        residual = length - unknown[3]
        slope = np.concatenate([normal, np.ones((len(points), 1))], axis=1)
        try:
            inverse = np.linalg.inv(slope.T @ slope)
        except np.linalg.LinAlgError:
            raise _no_feature("sphere", len(points)) from None
        step = inverse @ slope.T @ residual
        unknown = unknown + step
        if np.abs(step).max() < _STILL * radius_mm:
            break
    else:
        raise _no_feature("sphere", len(points))
    variance = np.einsum("ni,nij,nj->n", normal, covariance, normal)
    worse = max(1.0, float(np.mean(residual**2) / np.mean(variance)))
    share = inverse @ slope.T
    of_radius = points_alike * worse * float(np.sum(share[3] ** 2 * variance))
    return FreeSphere(unknown[:3], float(unknown[3]), float(np.sqrt(of_radius)), _form(residual, variance))


def fit_free_plane(points: Floats, covariance: Floats) -> tuple[Form, Mask]:
    """Return what remains of points (n, 3) in mm about their plane, and which of them belong to it.

    `covariance` is (n, 3, 3) in mm^2. Points beyond four robust standard deviations are left out, and the
    plane is fitted again until they stay the same. Raises `InvalidInput` where the points hold no plane.
    """
    if len(points) < 4:
        raise _no_feature("plane", len(points))
    used = np.ones(len(points), np.bool_)
    for _ in range(_STEPS):
        middle = points[used].mean(axis=0)
        _, spread, axes = np.linalg.svd(points[used] - middle, full_matrices=False)
        if spread[1] <= _STILL * spread[0]:
            raise _no_feature("plane", len(points))
        distance = (points - middle) @ axes[2]
        robust = _TO_SIGMA * float(np.median(np.abs(distance[used])))
        before, used = used, np.abs(distance) <= _OUTLIER * robust
        if np.array_equal(before, used):
            break
    variance = np.einsum("i,nij,j->n", axes[2], covariance[used], axes[2])
    return _form(distance[used], variance), used


def _form(residual: Floats, variance: Floats) -> Form:
    low, high = int(residual.argmin()), int(residual.argmax())
    span = float(residual[high] - residual[low])
    return Form(span, float(np.sqrt(variance[low] + variance[high])), len(residual))


def _no_feature(what: str, count: int) -> InvalidInput:
    return InvalidInput(f"{count} points hold no {what}: measure more of it, or check the mask")
