"""The centre of a sphere of known radius from points of its surface that are uncertain along their rays."""

from __future__ import annotations

from dataclasses import dataclass
from math import sin

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask

OUTLIER_LIMIT = 4.0
"""Points farther off, in standard deviations, are outliers: one good point in 16,000."""

_NEAR = 1.0 / 3.0  # of the radius: what a search may be wrong by, and more
_TUKEY = 4.685  # 95 % efficiency for Gaussian noise
_TO_SIGMA = 1.4826  # from the median of magnitudes
_LEAST_POINTS = 12
_STEPS = 15
_STEP_TOLERANCE = 1e-3  # of the radius: far within what the plain fit starts from
_ROBUST_POINTS = 1500
_RINGS, _SECTORS = 3, 8


@dataclass(frozen=True)
class SphereFit:
    """A sphere through points.

    Attributes
    ----------
    centre, covariance
        (3,) in mm and (3, 3) in mm^2, with the known radius.
    radius, radius_sigma
        In mm, when the radius is free as well: a check, not used for the centre.
    rms
        Root mean square of the residuals along the rays, in mm.
    misfit
        The same in units of the points' standard deviations: 1 for a true sphere and true deviations.
    coverage
        Part of the cap within the limit of incidence that has points, by 24 cells of equal area.
    inlier
        (n,): which of the points the centre was fitted to.
    limb, front, behind
        (n,): which of them were left out because they are seen too obliquely, because they lie in front of
        the surface, or behind it.
    """

    centre: Floats
    covariance: Floats
    radius: float
    radius_sigma: float
    rms: float
    misfit: float
    coverage: float
    inlier: Mask
    limb: Mask
    front: Mask
    behind: Mask


def ray_residuals(
    directions: Floats, distances: Floats, offset: Floats, radius: float
) -> tuple[Floats, Floats, Floats]:
    """Say how far points lie behind a sphere's surface along their rays.

    Parameters
    ----------
    directions, distances
        (n, 3) unit vectors from the camera, and (n,) distances along them in mm.
    offset
        (3,) centre of the sphere less that of the camera, in mm.
    radius
        In mm.

    Returns
    -------
    residual
        (n,) rho - rho* in mm, with rho* = u . w - sqrt(R^2 - b^2); NaN for rays that miss the sphere.
    slope
        (n, 4): derivative of rho* by the centre, n / (n . u), and by the radius, 1 / (n . u), with the
        outward normal n where the ray enters.
    sine
        (n,) b / R, the sine of the incidence; it does not depend on the noise along the ray, so that
        choosing points by it does not bias the centre.
    """
    along = directions @ offset
    across = np.maximum(offset @ offset - along * along, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.sqrt(radius * radius - across)
        entry = along - depth
        normal = (entry[:, None] * directions - offset) / radius
        cosine = -depth / radius
        slope = np.concatenate([normal, np.ones_like(normal[:, :1])], axis=1) / cosine[:, None]
    return np.asarray(distances - entry), slope, np.sqrt(across) / radius


def _solve(slope: Floats, residual: Floats, weight: Floats) -> Floats:
    weighted = slope * weight[:, None]
    return np.asarray(np.linalg.solve(weighted.T @ slope, weighted.T @ residual))


def fit_sphere(
    points: Floats,
    sigma: Floats,
    camera_centre: Floats,
    start: Floats,
    radius_mm: float,
    incidence_limit: float,
) -> SphereFit | None:
    """Fit a sphere of known radius to points, some of which lie elsewhere.

    Parameters
    ----------
    points, sigma
        (n, 3) in mm, and (n,) standard deviations along the rays in mm.
    camera_centre, start
        (3,) in mm; the start may be wrong by a third of the radius.
    radius_mm
        Of the sphere.
    incidence_limit
        Points that are seen more obliquely are left out, in rad.

    Returns
    -------
    None where too few points are left to hold a sphere.

    Notes
    -----
    Minimises the squared distances along the rays by Gauss-Newton; first with Tukey's weights at a scale
    from the median, then plainly over the points within 4 standard deviations, which are taken as larger
    than stated when the median says so. The covariance is (J^T W J)^-1, times the reduced chi-square where
    that exceeds 1.
    """
    rays = points - camera_centre
    distances = np.linalg.norm(rays, axis=1)
    directions = rays / distances[:, None]
    sine_limit = sin(incidence_limit)
    thin = slice(None, None, max(1, len(points) // _ROBUST_POINTS))
    offset = _robustly(
        directions[thin], distances[thin], sigma[thin], start - camera_centre, radius_mm, sine_limit
    )
    if offset is None:
        return None
    found = _plainly(directions, distances, sigma, offset, radius_mm, sine_limit)
    if found is None or np.linalg.norm(found[0] + camera_centre - start) > radius_mm:
        return None
    offset, inlier = found
    return _report(directions, distances, sigma, offset, camera_centre, radius_mm, inlier, sine_limit)


def _robustly(
    directions: Floats, distances: Floats, sigma: Floats, offset: Floats, radius_mm: float, sine_limit: float
) -> Floats | None:
    """Return a centre that most of the points around a first one agree on."""
    for _ in range(_STEPS):
        residual, slope, sine = ray_residuals(directions, distances, offset, radius_mm)
        use = (sine <= sine_limit) & (np.abs(residual) < _NEAR * radius_mm)
        if np.count_nonzero(use) < _LEAST_POINTS:
            return None
        residual, slope, deviation = residual[use], slope[use, :3], sigma[use]
        standard = np.abs(residual) / deviation
        scale = _scale(standard)
        weight = (np.maximum(1.0 - (standard / (_TUKEY * scale)) ** 2, 0.0) / deviation) ** 2
        try:
            change = _solve(slope, residual, weight)
        except np.linalg.LinAlgError:
            return None
        length = float(np.linalg.norm(change))
        if length < _STEP_TOLERANCE * radius_mm:
            break
        # A step may not leave the neighbourhood in which the linear model holds.
        offset = offset + change * min(1.0, _NEAR * radius_mm / length)
    return offset


def _plainly(
    directions: Floats, distances: Floats, sigma: Floats, offset: Floats, radius_mm: float, sine_limit: float
) -> tuple[Floats, Mask] | None:
    """Return the least-squares centre of the points that lie on the surface, and which these are."""
    inlier = np.zeros(len(sigma), dtype=np.bool_)
    for _ in range(_STEPS):
        residual, slope, sine = ray_residuals(directions, distances, offset, radius_mm)
        use = (sine <= sine_limit) & (np.abs(residual) < _NEAR * radius_mm)
        if np.count_nonzero(use) < _LEAST_POINTS:
            return None
        standard = np.abs(residual) / sigma
        before, inlier = inlier, use & (standard <= OUTLIER_LIMIT * _scale(standard[use]))
        if np.count_nonzero(inlier) < _LEAST_POINTS:
            return None
        try:
            change = _solve(slope[inlier, :3], residual[inlier], sigma[inlier] ** -2.0)
        except np.linalg.LinAlgError:
            return None
        length = float(np.linalg.norm(change))
        offset = offset + change * min(1.0, _NEAR * radius_mm / max(length, 1e-300))
        if length < 1e-9 * radius_mm and np.array_equal(before, inlier):
            break
    return offset, inlier


def _scale(standard: Floats) -> float:
    """Return by how much deviations are larger than stated, from the median of standardised residuals."""
    return max(1.0, _TO_SIGMA * float(np.median(standard)))


def _report(
    directions: Floats,
    distances: Floats,
    sigma: Floats,
    offset: Floats,
    camera_centre: Floats,
    radius_mm: float,
    inlier: Mask,
    sine_limit: float,
) -> SphereFit | None:
    residual, slope, sine = ray_residuals(directions, distances, offset, radius_mm)
    good = residual[inlier]
    weight = 1.0 / sigma[inlier] ** 2
    free = np.append(offset, radius_mm)
    try:
        covariance = np.asarray(np.linalg.inv((slope[inlier, :3] * weight[:, None]).T @ slope[inlier, :3]))
        for _ in range(4):
            left, by_all, _sine = ray_residuals(
                directions[inlier], distances[inlier], free[:3], float(free[3])
            )
            seen = np.isfinite(left)
            if np.count_nonzero(seen) < _LEAST_POINTS:
                return None
            free = free + _solve(by_all[seen], left[seen], weight[seen])
        radius_variance = np.linalg.inv((slope[inlier] * weight[:, None]).T @ slope[inlier])[3, 3]
    except np.linalg.LinAlgError:
        return None
    reduced = float(np.sum(good**2 * weight)) / max(good.size - 3, 1)
    inflation = max(1.0, reduced)
    off = np.abs(residual) > OUTLIER_LIMIT * _scale(np.abs(good) / sigma[inlier]) * sigma
    cap = sine <= sine_limit
    around = (
        np.abs(np.linalg.norm(distances[:, None] * directions - offset, axis=1) / radius_mm - 1.0) < _NEAR
    )
    return SphereFit(
        centre=offset + camera_centre,
        covariance=covariance * inflation,
        radius=float(free[3]),
        radius_sigma=float(np.sqrt(radius_variance * inflation)),
        rms=float(np.sqrt(np.mean(good**2))),
        misfit=float(np.sqrt(reduced)),
        coverage=_coverage(directions[inlier], offset, radius_mm * sine_limit),
        inlier=inlier,
        limb=around & ~cap,
        front=cap & off & (residual < 0.0),
        behind=cap & off & (residual > 0.0),
    )


def _coverage(directions: Floats, offset: Floats, radius: float) -> float:
    """Return the part of 24 cells of equal area of a cap that rays meet."""
    axis = offset / np.linalg.norm(offset)
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    nearest = directions * (directions @ offset)[:, None] - offset
    x, y = nearest @ first / radius, nearest @ np.cross(axis, first) / radius
    ring = np.minimum((x * x + y * y) * _RINGS, _RINGS - 1).astype(np.int64)
    sector = np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    return np.unique(ring * _SECTORS + sector).size / (_RINGS * _SECTORS)


def spread_pixels(pixels: NDArray[np.int32], limit: int) -> Ints:
    """Choose pixels that are evenly spread over the area that all of them cover.

    Parameters
    ----------
    pixels
        (n, 2) row and column, each once.
    limit
        Most pixels to choose, at least 1.

    Returns
    -------
    (m,) indices, m <= limit: of each square of a grid, as fine as the limit allows, the pixel nearest its
    middle.
    """
    if len(pixels) <= limit:
        return np.arange(len(pixels))
    from_corner = pixels - pixels.min(axis=0) + 0.5
    pitch = np.sqrt(len(pixels) / limit)
    while True:
        square = np.floor(from_corner / pitch).astype(np.int64)
        key = square[:, 0] * (square[:, 1].max() + 1) + square[:, 1]
        if np.unique(key).size <= limit:
            break
        pitch *= 1.01
    off_middle = np.sum((from_corner - (square + 0.5) * pitch) ** 2, axis=1)
    order = np.lexsort((off_middle, key))
    _, first = np.unique(key[order], return_index=True)
    return np.sort(order[first])
