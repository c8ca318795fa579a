"""What a pair's parameters make of its pixels: points, gaps, and sensors that have moved a little."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import PER_POSE, Pose, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix

Parameters: TypeAlias = tuple[Intrinsics, Pose]
"""Inner parameters and pose of a sensor."""


def moved_sensor(sensor: Parameters, step: Floats) -> Parameters:
    """Return a sensor after a change of its parameters; R <- exp([r]x) R, everything else is added."""
    intrinsics, pose = sensor
    turned = rotation_matrix(step[:3]) @ pose.matrix()
    shifted = np.array(pose.translation) + step[3:PER_POSE]
    changed = Intrinsics.from_vector(intrinsics.vector() + step[PER_POSE:])
    return changed, Pose.from_arrays(turned, shifted)


def meet_rays(
    camera: Parameters, projector: Parameters, camera_px: Floats, projector_px: Floats
) -> tuple[Floats, Floats]:
    """Return where rays come closest, on the camera's (n, 3) in mm, and the signed gaps (n,) in mm.

    The same as `geometry.triangulation.triangulate` makes of the pixels of a whole image (thesis Fig. 12).
    NaN outside a lens's valid field.
    """
    u, v = ray_directions(*camera, camera_px), ray_directions(*projector, projector_px)
    normal = np.cross(u, v)
    base = projector[1].centre() - camera[1].centre()
    square = np.sum(normal * normal, axis=-1)
    along = np.sum(np.cross(base, v) * normal, axis=-1) / square
    return camera[1].centre() + along[..., None] * u, np.asarray(normal @ base / np.sqrt(square))


def box_grid(low: Floats, high: Floats, per_side: int = 7) -> Floats:
    """Return the points (per_side^3, 3) of a regular grid that fills a box, corners included."""
    axes = [np.linspace(a, b, per_side) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
