"""Virtual strain gauges, and profiles of fields along lines on a surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.geometry.transforms import unpack

LEAST_PIXELS = 12
"""Under the grid of a gauge that reads anything."""


@dataclass(frozen=True)
class GaugePlace:
    """Where a strain gauge sits, in the specimen's frame.

    Attributes
    ----------
    x, y
        Middle of its grid, seen along the frame's z axis.
    length, width
        Of the grid, along the direction that it measures and across it.
    angle_rad
        Direction that it measures, from the frame's x axis towards its y axis.
    """

    x: float
    y: float
    length: float
    width: float
    angle_rad: float = 0.0

    @property
    def half_diagonal(self) -> float:
        """Of the grid."""
        return 0.5 * float(np.hypot(self.length, self.width))

    @property
    def reach(self) -> float:
        """How far from its middle a gauge looks for a point to stand on; without one it reads nothing."""
        return 0.25 * min(self.length, self.width) + self.half_diagonal / LEAST_PIXELS


@dataclass(frozen=True)
class GaugeValue:
    """What a virtual gauge reads: strain along its direction, standard deviation, pixels under its grid.

    NaN where fewer than twelve pixels are there.

    Attributes
    ----------
    under
        (rows, columns), which those pixels are.
    axes
        (2, 3), unit vectors along and across the grid.
    slopes
        (2, 3), of the displacement along them.
    """

    strain: float
    sigma: float
    pixels: int
    middle: Floats
    under: Mask
    axes: Floats
    slopes: Floats


def read_gauge(
    place: GaugePlace,
    xyz: Floats,
    displacement: Floats,
    covariance: NDArray[np.floating],
    labels: NDArray[np.int32],
    *,
    green_lagrange: bool = True,
) -> GaugeValue:
    """Return the mean strain of the surface under a gauge, along its direction.

    Parameters
    ----------
    place
        Of the gauge.
    xyz, displacement
        (3, rows, columns) in mm, in the specimen's frame; NaN where there is none.
    covariance
        (6, rows, columns) in mm^2, in that frame, as if independent from pixel to pixel: see
        `strain_errors.SharedErrors.every`.
    labels
        (rows, columns); a gauge reads the region that is under its middle.
    green_lagrange
        True for Green-Lagrange strain, False for small strain.

    Notes
    -----
    The grid's displacement is fitted by an affine field over the pixels under it, in the surface's tangent
    plane there: a resistance gauge reads the mean elongation along its grid. With the slope d of the fit
    along the direction e, the strain is e . d, and with Green-Lagrange strain (d . d) / 2 more.
    """
    valid = (labels > 0) & np.isfinite(xyz).all(axis=0) & np.isfinite(displacement).all(axis=0)
    flat = np.hypot(xyz[0] - place.x, xyz[1] - place.y)
    flat[~valid] = np.inf
    nearest = np.unravel_index(np.argmin(flat), flat.shape)
    if not flat[nearest] <= place.reach:
        return _missing(valid)
    middle = xyz[:, nearest[0], nearest[1]]
    near = valid & (labels == labels[nearest])
    near &= np.sum((xyz - middle[:, None, None]) ** 2, axis=0) <= place.half_diagonal**2
    points = xyz[:, near] - middle[:, None]
    if points.shape[1] < LEAST_PIXELS:
        return _missing(valid)
    along, across = _grid_axes(points, place.angle_rad)
    s, t = along @ points, across @ points
    under = (np.abs(s) <= 0.5 * place.length) & (np.abs(t) <= 0.5 * place.width)
    if np.count_nonzero(under) < LEAST_PIXELS:
        return _missing(valid)
    s, t = s[under] - s[under].mean(), t[under] - t[under].mean()
    normal = np.array([[s @ s, s @ t], [s @ t, t @ t]])
    if not np.linalg.det(normal) > 1e-6 * normal[0, 0] * normal[1, 1]:
        return _missing(valid)
    inverse = np.linalg.inv(normal)
    slopes = inverse @ np.stack([s, t]) @ displacement[:, near][:, under].T
    slope = slopes[0]
    strain = float(along @ slope) + (0.5 * float(slope @ slope) if green_lagrange else 0.0)
    direction = along + (slope if green_lagrange else 0.0)
    mean: Floats = np.mean(covariance[:, near][:, under], axis=1, dtype=np.float64)
    spread = unpack(mean)
    variance = float(inverse[0, 0] * (direction @ spread @ direction))
    near[near] = under
    return GaugeValue(
        strain,
        float(np.sqrt(variance)),
        int(np.count_nonzero(under)),
        middle.copy(),
        near,
        np.stack([along, across]),
        slopes,
    )


def _missing(valid: Mask) -> GaugeValue:
    nothing = float("nan")
    nowhere = np.full((2, 3), nothing)
    return GaugeValue(nothing, nothing, 0, nowhere[0], np.zeros_like(valid), nowhere, nowhere)


def _grid_axes(points: Floats, angle_rad: float) -> tuple[Floats, Floats]:
    """Return unit vectors along and across a grid in the tangent plane of points (3, n)."""
    _, vectors = np.linalg.eigh(np.cov(points))
    normal = vectors[:, 0]
    direction = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    along = direction - normal * (normal @ direction)
    along /= np.linalg.norm(along)
    return along, np.cross(normal, along)


@dataclass(frozen=True)
class Profile:
    """A field along a line.

    Attributes
    ----------
    distance
        (n,), from the line's start, in mm.
    position
        (n, 3), mean place of the pixels, in the specimen's frame, mm; NaN where there are none.
    value
        (components, n), their mean.
    scatter
        (components, n), their standard deviation: of the field over the strip and of its noise.
    pixels
        (n,), how many there are.
    """

    distance: Floats
    position: Floats
    value: Floats
    scatter: Floats
    pixels: Ints


def profile_along(
    xyz: Floats,
    field: Floats,
    start: tuple[float, float],
    end: tuple[float, float],
    *,
    step_mm: float,
    width_mm: float,
) -> Profile:
    """Return the means of a field over pieces of a strip between two points, seen along the frame's z axis.

    Parameters
    ----------
    xyz
        (3, rows, columns) in mm, in the specimen's frame.
    field
        (components, rows, columns); pixels where any is NaN do not count.
    start, end
        Ends of the line, (x, y) in mm.
    step_mm, width_mm
        Length and width of a piece.
    """
    line = np.subtract(end, start)
    length = float(np.linalg.norm(line))
    direction = line / length
    pieces = max(1, round(length / step_mm))
    dx, dy = xyz[0] - start[0], xyz[1] - start[1]
    along = dx * direction[0] + dy * direction[1]
    across = dy * direction[0] - dx * direction[1]
    finite = np.isfinite(xyz).all(axis=0) & np.isfinite(field).all(axis=0)
    inside = finite & (along >= 0.0) & (along <= length) & (np.abs(across) <= 0.5 * width_mm)
    piece = np.minimum((along[inside] / length * pieces).astype(np.int64), pieces - 1)
    count = np.bincount(piece, minlength=pieces)
    divisor = np.where(count > 0, count, np.nan)

    def mean(values: Floats) -> Floats:
        return np.stack([np.bincount(piece, each, pieces) / divisor for each in values])

    value = mean(field[:, inside])
    scatter = np.sqrt(mean((field[:, inside] - value[:, piece]) ** 2))
    distance = (np.arange(pieces) + 0.5) * length / pieces
    return Profile(distance, mean(xyz[:, inside]).T, value, scatter, count)
