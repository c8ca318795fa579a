"""Single points of a surface that was measured at some pixels only, and what gauges between them read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.transforms import unpack

_UNKNOWNS: Final = 6
_LEAST: Final = 2 * _UNKNOWNS
_HOLE: Final = 5
"""Of fewer places, each way, that lack a position amid a region, such as a dark speckle, none is an edge."""
_MOST_LEVERAGE: Final = 0.3
"""Of a fit over half a disc, at its edge; beyond, a point is not between those that it is fitted to."""


@dataclass(frozen=True)
class SparseSurface:
    """Positions at every `step`-th pixel of an image, from pixel (`first`, `first`) on.

    Attributes
    ----------
    xyz, covariance
        (3, rows, columns) in mm and (6, rows, columns) in mm^2; NaN where there is none.
    labels
        (rows, columns), continuous regions, 0 for none.
    step, first
        In px of the image.
    subset_radius_px
        Distance over which errors of positions go together, 0 where each is of its own.
    """

    xyz: Floats
    covariance: NDArray[np.floating]
    labels: NDArray[np.int32]
    step: int
    first: int
    subset_radius_px: int = 0

    def spread(self, rows: int, columns: int) -> NDArray[np.int32]:
        """Return the labels of all pixels of the image (rows, columns): the nearest one's, without holes."""
        full = np.zeros((rows, columns), np.int32)
        labels = np.where(self.labels > 0, self.labels, ndimage.grey_closing(self.labels, size=_HOLE))
        large = np.repeat(np.repeat(labels, self.step, axis=0), self.step, axis=1)[:rows, :columns]
        full[: large.shape[0], : large.shape[1]] = large
        return full

    def label_at(self, row: float, column: float) -> int:
        """Return the region nearest to a place, in rows and columns of its own; 0 where none is near."""
        rows, columns = self.labels.shape
        if not (-0.5 <= row <= rows - 0.5 and -0.5 <= column <= columns - 0.5):
            return 0
        top, left = max(round(row) - _HOLE // 2, 0), max(round(column) - _HOLE // 2, 0)
        about = self.labels[top : round(row) + _HOLE // 2 + 1, left : round(column) + _HOLE // 2 + 1]
        down, across = np.nonzero(about)
        if not len(down):
            return 0
        nearest = np.argmin(np.hypot(top + down - row, left + across - column))
        return int(about[down[nearest], across[nearest]])


@dataclass(frozen=True)
class FittedPoint:
    """A point of a surface, (3,) in mm, its covariance (3, 3), its slopes along x and y, (3, 2) in mm/px."""

    position: Floats
    covariance: Floats
    slope: Floats


def fitted_point(surface: SparseSurface, x: float, y: float, radius: float) -> FittedPoint | None:
    """Return the point of a surface at a place of the image; None where too little is measured about it.

    Parameters
    ----------
    x, y
        In px of the image.
    radius
        Within which positions are fitted, in px of the image; three steps at least.

    Notes
    -----
    A quadratic in x and y is fitted to the positions of the region of the nearest one. Its covariance is that
    of the positions, or of what the fit leaves over where that is more. Positions whose subsets overlap count
    as one, so that a fit over less than a subset is as uncertain as one position.
    """
    column, row = (x - surface.first) / surface.step, (y - surface.first) / surface.step
    reach = max(radius / surface.step, 3.0)
    label = surface.label_at(row, column)
    if not label:
        return None
    top, left = max(int(row - reach), 0), max(int(column - reach), 0)
    window = np.s_[top : int(row + reach) + 2, left : int(column + reach) + 2]
    same = surface.labels[window] == label
    down, across = np.nonzero(same)
    dx, dy = (left + across - column) / reach, (top + down - row) / reach
    near = dx**2 + dy**2 <= 1.0
    dx, dy = dx[near], dy[near]
    if len(dx) < _LEAST:
        return None
    points = surface.xyz[(slice(None), *window)][:, same][:, near].T
    design = np.stack([np.ones_like(dx), dx, dy, dx * dx, dx * dy, dy * dy], axis=1)
    normal = design.T @ design
    if not np.linalg.cond(normal) < 1e8:
        return None
    inverse = np.linalg.inv(normal)
    if not inverse[0, 0] <= _MOST_LEVERAGE:
        return None
    found = inverse @ (design.T @ points)
    left_over = points - design @ found
    scatter = left_over.T @ left_over / (len(dx) - _UNKNOWNS)
    mean = surface.covariance[(slice(None), *window)][:, same][:, near].mean(axis=1, dtype=np.float64)
    noise: Floats = unpack(mean)
    own = scatter if np.trace(scatter) > np.trace(noise) else noise
    together = max(1.0, ((2 * surface.subset_radius_px + 1) / surface.step) ** 2)
    return FittedPoint(
        found[0], min(inverse[0, 0] * together, 1.0) * own, found[1:3].T / (reach * surface.step)
    )


def place_of(surface: SparseSurface, x_mm: float, y_mm: float, radius: float) -> tuple[float, float] | None:
    """Return where in the image, x and y in px, a place of a surface lies, seen along the surface's z axis.

    None where nothing is measured there. `radius` as of `fitted_point`.
    """
    far = np.hypot(surface.xyz[0] - x_mm, surface.xyz[1] - y_mm)
    far = np.where((surface.labels > 0) & np.isfinite(far), far, np.inf)
    row, column = np.unravel_index(int(np.argmin(far)), far.shape)
    x, y = (float(surface.first + surface.step * n) for n in (column, row))
    if not np.isfinite(far[row, column]) or (fitted := fitted_point(surface, x, y, radius)) is None:
        return None
    slope = fitted.slope[:2]
    if not abs(np.linalg.det(slope)) > 1e-3 * np.sum(slope**2):
        return None  # seen from its edge
    dx, dy = np.linalg.solve(slope, [x_mm, y_mm] - fitted.position[:2])
    # The nearest pixel of the grid is no farther away than one step, where the place is on the surface.
    return (x + float(dx), y + float(dy)) if np.hypot(dx, dy) <= surface.step else None


@dataclass(frozen=True)
class MovedPoint:
    """A point at rest and where it has come to, (3,) in mm, and the covariance of the way, (3, 3) in mm^2."""

    start: Floats
    end: Floats
    covariance: Floats


def moved_point(start: FittedPoint, end: FittedPoint, sigma_px: NDArray[np.floating]) -> MovedPoint:
    """Return how far a point has moved; `sigma_px` (2,) are standard deviations of the match, in px."""
    matched = end.slope @ np.diag(np.square(sigma_px)) @ end.slope.T
    return MovedPoint(start.position, end.position, start.covariance + end.covariance + matched)


def extension(one: MovedPoint, other: MovedPoint) -> tuple[float, float]:
    """Return by how much the distance of two points has grown, in mm, and its standard deviation."""
    apart = other.end - one.end
    length = float(np.linalg.norm(apart))
    along = apart / length
    variance = float(along @ (one.covariance + other.covariance) @ along)
    return length - float(np.linalg.norm(other.start - one.start)), float(np.sqrt(variance))
