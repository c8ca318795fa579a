"""Where a registration may start: the principal axes of points and surface, in every order."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from sms_jobs.errors import MeasurementFailed
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import transform
from sms_jobs.metrology.surfaces.registration import MeasuredPoints, Registration, distances_to, register
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface

_FEW, _MORE = 300, 1000  # points
_FIRST, _THEN = 8, 40  # iterations
_FINALISTS = 3
_ALIKE = 0.02  # of the part's size: two poses nearer than this are one
_MARGIN = 1.5


@dataclass(frozen=True)
class _Candidate:
    found: Registration
    error: float  # mm


def coarse_registration(surface: TriangleSurface, points: MeasuredPoints, *, threads: int = 1) -> Pose:
    """Lay points on a surface that may be anywhere.

    Parameters
    ----------
    surface
        The reference.
    points
        What was measured: most of the surface, or a part whose shape is found there once.

    Returns
    -------
    x_surface = R x + T, near enough to register from.

    Raises
    ------
    MeasurementFailed
        Nothing fits, or two places fit about as well.

    Notes
    -----
    The centroids are laid on each other, and the principal axes in each of the 24 orders and signs that are
    rotations, each also turned by 45 degrees about the third axis for parts about as long as wide. Ten
    iterations with some hundred points tell which are worth going on with.
    """
    middle, axes = _principal_axes_of(surface)
    few, more = points.some(_FEW), points.some(_MORE)
    centre = points.xyz.mean(axis=0)
    _, own = np.linalg.eigh(np.cov((points.xyz - centre).T))
    size = float(np.linalg.norm(np.ptp(points.xyz, axis=0)))
    first = []
    for order in _orders():
        rotation = axes @ order @ own.T
        rotation *= np.sign(np.linalg.det(rotation))
        start = Pose.from_arrays(rotation, middle - rotation @ centre)
        candidate = _tried(surface, few, start, _FIRST, size, threads)
        if candidate is not None:
            first.append(candidate)
    finalists: list[_Candidate] = []
    for candidate in sorted(first, key=lambda c: c.error):
        if len(finalists) < _FINALISTS and not any(
            _apart(candidate, other, few) < _ALIKE * size for other in finalists
        ):
            finalists.append(candidate)
    last = [_tried(surface, more, c.found.pose, _THEN, size, threads) for c in finalists]
    ranked = sorted((c for c in last if c is not None), key=lambda c: c.error)
    if not ranked:
        raise MeasurementFailed(
            "no orientation of the points fits the reference surface; give a start, and check its unit and "
            "that its triangles face outwards"
        )
    best = ranked[0]
    for other in ranked[1:]:
        same = _apart(best, other, few) < _ALIKE * size
        if not same and not best.found.held and other.error < _MARGIN * best.error:
            raise MeasurementFailed(
                f"two places fit about as well, with a median distance of {best.error:.3g} and "
                f"{other.error:.3g} mm: the part is symmetric, or too little of it was seen; give a start"
            )
    return best.found.pose


def _orders() -> list[Floats]:
    """Return the 24 rotations that lay axes on axes, and each turned by 45 degrees about the third."""
    half = np.sqrt(0.5)
    turned = np.array([[half, -half, 0.0], [half, half, 0.0], [0.0, 0.0, 1.0]])
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        if np.linalg.det(matrix) > 0.0:
            found += [matrix, turned @ matrix]
    return found


def _principal_axes_of(surface: TriangleSurface) -> tuple[Floats, Floats]:
    """Return the centroid and the principal axes, as columns of a rotation, of a surface's area."""
    corners, area = surface.triangles, surface.area()
    share = area / area.sum()
    middles = corners.mean(axis=1)
    centroid = share @ middles
    # Of a triangle the second moment is that of its corners and of nine times its middle, over 12.
    about = np.concatenate([corners, 3.0 * middles[:, None]], axis=1) - np.r_[1.0, 1.0, 1.0, 3.0][:, None] * (
        centroid
    )
    moment = np.einsum("n,nki,nkj->ij", share / 12.0, about, about)
    _, axes = np.linalg.eigh(moment)
    return centroid, np.asarray(axes * np.sign(np.linalg.det(axes)))


def _tried(
    surface: TriangleSurface, points: MeasuredPoints, start: Pose, iterations: int, size: float, threads: int
) -> _Candidate | None:
    """Register from a start; None where nothing faces the surface."""
    try:
        found = register(surface, points, start, iterations=iterations, threads=threads)
    except MeasurementFailed:
        return None
    closest, _, trusted = distances_to(surface, points, found.pose, np.inf, threads)
    # A point that faces nothing is as wrong as the part is large.
    error = float(np.median(np.where(trusted, np.abs(closest.distance), size)))
    return _Candidate(found, error)


def _apart(one: _Candidate, other: _Candidate, points: MeasuredPoints) -> float:
    """Return by how much two poses move points differently, rms in mm."""
    between = transform(one.found.pose, points.xyz) - transform(other.found.pose, points.xyz)
    return float(np.sqrt(np.mean(np.sum(between**2, axis=1))))
