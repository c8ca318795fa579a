"""A measured field against another one: of a calculation, or of another measurement (thesis Fig. 72, 73)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.rigid_alignment import align_points
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import compose, transform

_NEIGHBOURS = 10
_LEAST_SPREAD = 1e-3


def values_at(points: Floats, values: Floats, at: Floats, within_mm: float) -> Floats:
    """Return a field, known at scattered points of a surface, at other points of about the same surface.

    Parameters
    ----------
    points, values
        (n, 3) in mm and (n, components); points where any component is NaN do not count.
    at
        (m, 3) in mm.
    within_mm
        A point with nothing nearer than this has no value.

    Returns
    -------
    (m, components), NaN where there is none.

    Notes
    -----
    A plane through the ten nearest points, weighted by inverse squared distance, in the two directions in
    which they spread most: exact for a field that is linear over the surface, also beyond its last point.
    """
    finite = np.isfinite(values).all(axis=1) & np.isfinite(points).all(axis=1)
    source, field = points[finite], values[finite]
    found = np.full((len(at), values.shape[1]), np.nan)
    count = min(_NEIGHBOURS, len(source))
    if count < 4:
        return found
    distance, index = cKDTree(source).query(at, count)
    near = np.flatnonzero(distance[:, 0] <= within_mm)
    weight = 1.0 / (distance[near] ** 2 + 1e-6 * distance[near, -1:] ** 2 + 1e-18)
    weight /= weight.sum(axis=1, keepdims=True)
    corner = source[index[near]]
    centre = np.einsum("nk,nki->ni", weight, corner)
    offset = corner - centre[:, None]
    scatter = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
    spread, axes = np.linalg.eigh(scatter)
    along = axes[:, :, 1:]
    place = offset @ along
    mean = np.einsum("nk,nkc->nc", weight, field[index[near]])
    moment = np.einsum("nk,nka,nkc->nac", weight, place, field[index[near]] - mean[:, None])
    slope = moment / np.maximum(spread[:, 1:], _LEAST_SPREAD * spread[:, 2:] + 1e-30)[:, :, None]
    target = np.einsum("ni,nia->na", at[near] - centre, along)
    found[near] = mean + np.einsum("na,nac->nc", target, slope)
    return found


def laid_on(source: Floats, target: Floats, iterations: int = 60) -> tuple[Pose, float]:
    """Return the rigid motion that lays points (n, 3) on others (m, 3), and the rms distance left, in mm.

    Iterative closest points from where they are (Besl and McKay 1992), each step a rigid fit by singular
    values; the farthest tenth does not count, since views overlap in part.
    """
    tree = cKDTree(target)
    pose = Pose.from_arrays(np.eye(3), np.zeros(3))
    rms = np.inf
    for _ in range(iterations):
        moved = transform(pose, source)
        distance, index = tree.query(moved)
        kept = distance <= np.quantile(distance, 0.9)
        pose = compose(align_points(moved[kept], target[index[kept]]), pose)
        last, rms = rms, float(np.sqrt(np.mean(distance[kept] ** 2)))
        if last - rms <= 1e-6 * rms:
            break
    return pose, rms


def free_of_motion(points: Floats, difference: Floats) -> Floats:
    """Return a difference of displacements (n, 3) at points (n, 3) without the rigid motion that fits best.

    Two tests of one specimen differ by how its grips gave; strain does not know of it.
    """
    finite = np.isfinite(difference).all(axis=1)
    pose = align_points(points[finite], (points + difference)[finite])
    return np.asarray(points + difference - transform(pose, points))
