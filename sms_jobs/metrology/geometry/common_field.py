"""What several cameras see together: a box about the place where they look."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Floats, Intrinsics

_LEAST_ANGLE = np.radians(1.0)  # the place where views that turn less to each other meet is beyond measure
_GRID = 41


@dataclass(frozen=True)
class CameraView:
    """A camera with the size of its image in px."""

    intrinsics: Intrinsics
    pose: Pose
    columns: int
    rows: int


def common_field(cameras: Sequence[CameraView]) -> tuple[Floats, Floats] | None:
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
    steps = np.linspace(-reach, reach, _GRID)
    points = middle + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    near = np.linalg.norm(points - middle, axis=1) <= reach
    seen = near & np.all([_sees(camera, points) for camera in cameras], axis=0)
    if not seen.any():
        return None
    # The box ends between points of the grid, and at round numbers.
    half, unit = 0.5 * (steps[1] - steps[0]), 10.0 ** np.floor(np.log10(0.1 * reach))
    low, high = points[seen].min(axis=0) - half, points[seen].max(axis=0) + half
    return unit * np.floor(low / unit), unit * np.ceil(high / unit)


def _ray(camera: CameraView, right: float, down: float) -> Floats:
    """Return the ray through a part of the image, both from 0 to 1."""
    pixel = np.array([right * camera.columns - 0.5, down * camera.rows - 0.5])
    return ray_directions(camera.intrinsics, camera.pose, pixel)


def _half_width(camera: CameraView, axis: Floats, along: float) -> float:
    """Return how far from its middle a camera sees at a distance along its axis, in mm."""
    corners = np.array([_ray(camera, right, down) for right in (0.0, 1.0) for down in (0.0, 1.0)])
    with np.errstate(divide="ignore", invalid="ignore"):
        away = corners / (corners @ axis)[:, None] - axis
    return along * float(np.nanmax(np.linalg.norm(away, axis=1), initial=0.0))


def _sees(camera: CameraView, points: Floats) -> Floats:
    with np.errstate(all="ignore"):
        pixels = project(camera.intrinsics, camera.pose, points)
    size = [camera.columns - 0.5, camera.rows - 0.5]
    return np.asarray(np.all((pixels >= -0.5) & (pixels <= size), axis=1))
