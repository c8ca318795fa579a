"""The specimen's own frame, from points of its surface: three of them, or two and a fitted plane.

Where a frame lies is as uncertain as its points. Their errors are carried to a small turn about the frame's
own axes and a shift of its origin along them: six numbers, by finite differences of the construction itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import rotation_vector, unpack

PICKED_WITHIN_PX = 0.5
"""Standard deviation, along each axis of the image, with which a person points at a mark."""
AVERAGED_PX = 5.0
"""Radius about a picked pixel within which its position is fitted."""

_LEAST_VALID = 0.5  # of the pixels about a picked one
_LEAST_SINE = 0.05  # of the angle at the origin: nearer to a line, three points tell no plane
_FEWEST_PIXELS = 100  # of a fitted plane
_TILES = 4  # along each side of the region's box: wider than what neighbours have in common
_ROUNDS = 4
_OUTLIER = 4.0  # in units of the scatter: three good pixels of ten thousand are farther off
_TO_SIGMA = 1.4826  # of a normal deviate, over its median size
_STEP = 1e-5  # of the distance between the points: differences are exact to its square


@dataclass(frozen=True)
class LocalPlace:
    """Where a place of an image lies on a surface.

    Attributes
    ----------
    place
        (3,), in the unit of the surface.
    covariance
        (3, 3), from the noise of the pixels about it.
    along
        (3, 2), by how much it moves with a pixel along the columns and the rows.
    """

    place: Floats
    covariance: Floats
    along: Floats

    def outward(self) -> Floats:
        """Return the unit normal of the surface that points to the camera, (3,)."""
        # x to the right, y down and the viewing direction are right-handed.
        normal = -np.cross(self.along[:, 0], self.along[:, 1])
        return np.asarray(normal / np.linalg.norm(normal))

    def pointed_at(self, in_image: Floats) -> LocalPlace:
        """Return it with the uncertainty of the place in the image, a covariance (2, 2) in px^2."""
        return replace(self, covariance=self.covariance + self.along @ in_image @ self.along.T)


def local_place(
    position: Floats,
    covariance: NDArray[np.floating],
    valid: Mask,
    pixel: tuple[float, float],
    *,
    radius_px: float = AVERAGED_PX,
    together: bool = False,
) -> LocalPlace:
    """Return where a place of an image lies: a plane in column and row, fitted to the pixels about it.

    Parameters
    ----------
    position, covariance
        (3, rows, columns) and (6, rows, columns).
    valid
        (rows, columns), which pixels have a position.
    pixel
        (column, row) in px.
    radius_px
        Of the pixels to which the plane is fitted.
    together
        Whether errors of near pixels go together, as those of subsets do, so that no mean makes them less.

    Raises
    ------
    InvalidInput
        It lies outside the image, fewer than half of the pixels about it have a position, or these lie on no
        smooth surface.
    """
    column, row = pixel
    rows, columns = valid.shape
    where = f"the pixel {column:g},{row:g}"
    if not (0.0 <= column <= columns - 1 and 0.0 <= row <= rows - 1):
        raise InvalidInput(f"{where} is not in the image, which has {columns} x {rows} px; pick one inside")
    r, c = np.mgrid[
        max(int(row - radius_px), 0) : min(int(row + radius_px) + 2, rows),
        max(int(column - radius_px), 0) : min(int(column + radius_px) + 2, columns),
    ].reshape(2, -1)
    near = np.hypot(c - column, r - row) <= radius_px
    known = near & valid[r, c]
    share = known.sum() / max(int(near.sum()), 1)
    if share < _LEAST_VALID:
        raise InvalidInput(
            f"only {share:.0%} of the pixels within {radius_px:g} px of {where} have a position, and "
            f"{_LEAST_VALID:.0%} are needed; pick a place within the measured surface"
        )
    r, c = r[known], c[known]
    design = np.stack([np.ones(len(r)), c - column, r - row], axis=1)
    inverse = np.linalg.pinv(design)
    points = position[:, r, c].T
    fitted = inverse @ points
    noise = unpack(np.asarray(covariance[:, r, c], dtype=np.float64))
    weight = inverse[0]
    own = (
        np.abs(weight).sum() ** 2 * noise.mean(axis=0)
        if together
        else np.einsum("n,nij->ij", weight**2, noise)
    )
    left = np.sqrt(np.mean(np.sum((points - design @ fitted) ** 2, axis=1)))
    stated = np.sqrt(np.mean(np.trace(noise, axis1=1, axis2=2)))
    pitch = np.sqrt(0.5 * np.sum(fitted[1:] ** 2))
    if left > 3.0 * stated + 0.1 * pitch:
        raise InvalidInput(
            f"the surface within {radius_px:g} px of {where} is {left:.3g} mm off a plane, with "
            f"{stated:.2g} mm stated; pick a place away from edges"
        )
    return LocalPlace(fitted[0], own, np.ascontiguousarray(fitted[1:].T))


def frame_through(origin: Floats, x: Floats, plane: Floats, outward: Floats | None = None) -> Pose:
    """Return the frame through three points: its origin, one on its x axis, one in its xy plane.

    Parameters
    ----------
    origin, x, plane
        (3,) in the world.
    outward
        (3,), to which side z points; where it is None, the third point has a positive y.

    Returns
    -------
    What brings the specimen's frame into the world: x_world = R x_specimen + T.

    Raises
    ------
    InvalidInput
        The points lie on, or near, one line.
    """
    along, aside = x - origin, plane - origin
    normal = np.cross(along, aside)
    lengths = np.linalg.norm(along) * np.linalg.norm(aside)
    if not np.linalg.norm(normal) > _LEAST_SINE * lengths:
        raise InvalidInput(
            "the three points lie nearly on one line and define no plane; pick the third well away "
            "from the line of the other two"
        )
    if outward is not None and normal @ outward < 0.0:
        normal = -normal
    return _frame(origin, along, normal)


def frame_on_plane(origin: Floats, x: Floats, middle: Floats, normal: Floats) -> Pose:
    """Return the frame whose xy plane is given by a point and its normal (3,), which is z.

    `origin` and `x` (3,), a point of the x axis, are projected onto it. Raises `InvalidInput` where they
    are one point there.
    """
    normal = normal / np.linalg.norm(normal)
    start = origin - ((origin - middle) @ normal) * normal
    along = x - origin
    if not np.linalg.norm(np.cross(normal, along)) > _LEAST_SINE * np.linalg.norm(along):
        raise InvalidInput(
            "the origin and the point of the x axis are one place of the plane; pick them apart from each "
            "other"
        )
    return _frame(start, along, normal)


def _frame(origin: Floats, along: Floats, normal: Floats) -> Pose:
    z = normal / np.linalg.norm(normal)
    x = along - (along @ z) * z
    x /= np.linalg.norm(x)
    return Pose.from_arrays(np.stack([x, np.cross(z, x), z], axis=1), origin)


def frame_jacobian(frame_of: Callable[[Floats], Pose], values: Floats, length: float) -> Floats:
    """Return by how much a frame turns and moves with each of the numbers that it is made of, (6, n).

    Parameters
    ----------
    frame_of
        Makes the frame of numbers (n,).
    values
        Those that it is made of.
    length
        Distance of its points in mm, of which small steps are a part.

    Returns
    -------
    Rows: a small turn about the frame's own x, y, z in rad, and a shift of its origin along them in mm.
    """
    here = frame_of(values)
    columns = []
    for number in range(len(values)):
        ends = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[number] += sign * _STEP * length
            there = frame_of(moved)
            turn = rotation_vector(here.matrix().T @ there.matrix())
            shift = here.matrix().T @ (np.array(there.translation) - here.translation)
            ends.append(np.concatenate([turn, shift]))
        columns.append((ends[0] - ends[1]) / (2.0 * _STEP * length))
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class FittedPlane:
    """A plane through points of a surface.

    Attributes
    ----------
    middle, normal
        (3,), the mean of the points, and a unit vector.
    across
        (3, 2), unit vectors in the plane.
    covariance
        (3, 3) of the tilt of the normal along both, in rad, and of the plane's height in mm.
    rms
        Of the points' distances, in mm.
    used
        (n,), which points took part.
    """

    middle: Floats
    normal: Floats
    across: Floats
    covariance: Floats
    rms: float
    used: Mask


def fit_plane(points: Floats, tiles: Ints, outward: Floats) -> FittedPlane:
    """Return the plane nearest to points of a surface; those beyond four times the scatter are left out.

    Parameters
    ----------
    points
        (n, 3) in mm.
    tiles
        (n,), which part of the region each is from, from 0.
    outward
        (3,), to which side the normal points.

    Raises
    ------
    InvalidInput
        They are fewer than 100, or lie on a line.

    Notes
    -----
    The covariance is that of the tile-wise jackknife (Miller 1974): each tile is left out in turn, so that
    what the surface is off a plane counts as well as noise, and points of one tile need not be independent.
    """
    if len(points) < _FEWEST_PIXELS:
        raise InvalidInput(
            f"the region has {len(points)} pixels with a position, and a plane needs {_FEWEST_PIXELS}; "
            "choose a larger one"
        )
    # About their own middle: squares of what is far from the world's origin would leave few digits.
    about = points.mean(axis=0)
    points = points - about
    used = np.ones(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        middle, normal, across = _plane_of(_moments(points[used]), outward)
        height = (points - middle) @ normal
        scatter = _TO_SIGMA * float(np.median(np.abs(height[used] - np.median(height[used]))))
        used = np.abs(height) <= _OUTLIER * max(scatter, 1e-12)
    middle, normal, across = _plane_of(_moments(points[used]), outward)
    height = (points[used] - middle) @ normal
    total, others = _moments(points[used]), []
    for tile in np.unique(tiles[used]):
        own = _moments(points[used & (tiles == tile)])
        rest, its_normal, _ = _plane_of(tuple(a - b for a, b in zip(total, own, strict=True)), outward)
        others.append([*(its_normal @ across), (rest - middle) @ its_normal / (normal @ its_normal)])
    each = np.array(others)
    off = each - each.mean(axis=0)
    covariance = (len(each) - 1) / len(each) * off.T @ off
    return FittedPlane(about + middle, normal, across, covariance, float(np.sqrt(np.mean(height**2))), used)


def _moments(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Return number, sum and sum of squares of points (n, 3)."""
    return np.array(float(len(points))), points.sum(axis=0), points.T @ points


def _plane_of(moments: tuple[Floats, ...], outward: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the middle, the normal and two directions of the plane nearest to points of some moments."""
    count, total, squares = moments
    middle = total / count
    spread, axes = np.linalg.eigh(squares / count - np.outer(middle, middle))
    if not spread[1] > 1e-4 * spread[2]:
        raise InvalidInput("the region is a line, which defines no plane; choose a wider one")
    normal = axes[:, 0] if axes[:, 0] @ outward > 0.0 else -axes[:, 0]
    return middle, normal, axes[:, 1:]


def tiles_of(rows: Ints, columns: Ints) -> Ints:
    """Return the tile of each pixel (n,): four by four over the box of all."""
    parts = []
    for each in (rows, columns):
        first, size = int(each.min()), int(np.ptp(each)) + 1
        parts.append((each - first) * _TILES // size)
    return np.asarray(parts[0] * _TILES + parts[1])


def plane_factor(plane: FittedPlane, points: Floats, factor: Floats) -> Floats:
    """Return by how much a fitted plane moves with each column of a factor (n, 3, r) of points (n, 3).

    Rows as those of its covariance, (3, r): the fit of a plane to the columns as it was to the points.
    """
    seen = np.isfinite(factor).all(axis=(1, 2))
    place = (points[seen] - plane.middle) @ plane.across
    design = np.column_stack([place, np.ones(len(place))])
    found = np.linalg.pinv(design) @ np.einsum("k,nkr->nr", plane.normal, factor[seen])
    # A surface that rises along a direction has a normal that leans back from it.
    return np.asarray(found * np.array([-1.0, -1.0, 1.0])[:, None])
