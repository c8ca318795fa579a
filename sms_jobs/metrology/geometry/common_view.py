"""What cameras see together: of a volume, from how different directions, and in which box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import starmap

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.camera import Camera, project, ray_directions

_SAME_RAY = 1e-6
"""In 1 - cos: 1.4 mrad between a point and the ray of its pixel, far more than rounding makes."""
_LEAST_ANGLE = np.radians(1.0)  # the place where views that turn less to each other meet is beyond measure
_GRID = 41
_PER_SIDE = 9
"""Points along each side of a box, and rays along each side of an image, by which the two meet."""


@dataclass(frozen=True)
class CommonView:
    """What two cameras see together.

    Attributes
    ----------
    seen
        Part of the points that both see.
    least_angle_rad
        The least angle between their lines of sight at these; NaN where there are none.
    usable
        Part of the points that both see at an angle that is not too large.
    """

    seen: float
    least_angle_rad: float
    usable: float


def common_view(first: Camera, second: Camera, points: Floats, largest_angle_rad: float) -> CommonView:
    """Return what two cameras see together of points (n, 3), in mm."""
    (sees, along), (also_sees, also_along) = starmap(_lines, ((first, points), (second, points)))
    both = sees & also_sees
    cosine = np.clip(np.sum(along * also_along, axis=-1)[both], -1.0, 1.0)
    angle = np.arccos(cosine)
    return CommonView(
        float(both.mean()),
        float(angle.min(initial=np.inf)) if both.any() else float("nan"),
        float(np.sum(angle <= largest_angle_rad) / len(points)),
    )


def _lines(camera: Camera, points: Floats) -> tuple[Mask, Floats]:
    """Return which points lie in the image, and the directions in which the camera sees all of them."""
    along = points - camera.pose.centre()
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    pixels = project(camera.intrinsics, camera.pose, points)
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= -0.5) & (pixels <= [camera.columns - 0.5, camera.rows - 0.5]), axis=-1)
        # A lens's polynomials fold what lies far outside back into the image.
        rays = ray_directions(camera.intrinsics, camera.pose, pixels)
        unfolded = np.sum(rays * along, axis=-1) > 1.0 - _SAME_RAY
    return inside & unfolded, along


def sees_some_of(camera: Camera, low: Floats, high: Floats) -> bool:
    """Say whether a camera or projector sees any of a box between corners (3,), in mm.

    Of a box that is small in its image some points are seen; through one that is large rays run.
    """
    points = np.stack(np.meshgrid(*np.linspace(low, high, _PER_SIDE).T), axis=-1).reshape(-1, 3)
    parts = np.linspace(0.0, 1.0, _PER_SIDE)
    rays = np.array([_ray(camera, right, down) for right in parts for down in parts])
    rays = rays[np.isfinite(rays).all(axis=-1)]
    with np.errstate(all="ignore"):
        if _lines(camera, points)[0].any():
            return True
        # The distances at which rays meet each pair of the box's planes; 0 / 0 lies in a plane all along.
        at = (np.stack([low, high]) - camera.pose.centre())[:, None] / rays
        enters, leaves = np.nanmax(at.min(axis=0), axis=-1), np.nanmin(at.max(axis=0), axis=-1)
    return bool(np.any(leaves >= np.maximum(enters, 0.0)))


def common_field(cameras: Sequence[Camera]) -> tuple[Floats, Floats] | None:
    """Return the corners (3,) and (3,), in mm, of a box about what cameras see together.

    The middle is where the rays of the middles of their images are nearest to each other. The box holds all
    points that every camera sees and that are no farther from the middle than a corner of the widest image
    shows there. None where no two views turn to each other by a degree, where the middle is behind a camera,
    or where they see nothing together.
    """
    holes = np.array([camera.pose.centre() for camera in cameras])
    axes = np.array([_ray(camera, 0.5, 0.5) for camera in cameras])
    if not np.isfinite(axes).all() or np.min(np.abs(axes @ axes.T)) > np.cos(_LEAST_ANGLE):
        return None
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, holes))
    along = np.sum((middle - holes) * axes, axis=1)
    if not np.all(along > 0.0):
        return None
    reach = float(np.nanmax([_half_width(*pair) for pair in zip(cameras, axes, along, strict=True)]))
    if not reach > 0.0:  # every corner of every image lies 90 degrees off or more
        return None
    steps = np.linspace(-reach, reach, _GRID)
    points = middle + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    near = np.linalg.norm(points - middle, axis=1) <= reach
    seen = near & np.all([_lines(camera, points)[0] for camera in cameras], axis=0)
    if not seen.any():
        return None
    # The box ends between points of the grid, and at round numbers.
    half, unit = 0.5 * (steps[1] - steps[0]), 10.0 ** np.floor(np.log10(0.1 * reach))
    low, high = points[seen].min(axis=0) - half, points[seen].max(axis=0) + half
    return unit * np.floor(low / unit), unit * np.ceil(high / unit)


def _ray(camera: Camera, right: float, down: float) -> Floats:
    """Return the ray through a part of the image, both from 0 to 1."""
    pixel = np.array([right * camera.columns - 0.5, down * camera.rows - 0.5])
    return ray_directions(camera.intrinsics, camera.pose, pixel)


def _half_width(camera: Camera, axis: Floats, along: float) -> float:
    """Return how far from its middle a camera sees at a distance along its axis, in mm."""
    corners = np.array([_ray(camera, right, down) for right in (0.0, 1.0) for down in (0.0, 1.0)])
    with np.errstate(divide="ignore", invalid="ignore"):
        away = corners / (corners @ axis)[:, None] - axis
    return along * float(np.nanmax(np.linalg.norm(away, axis=1), initial=0.0))
