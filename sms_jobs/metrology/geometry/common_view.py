"""What two cameras see together of a volume, and from how different directions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import starmap

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Floats, Intrinsics

_SAME_RAY = 1e-6
"""In 1 - cos: 1.4 mrad between a point and the ray of its pixel, far more than rounding makes."""


@dataclass(frozen=True)
class Looking:
    """A camera: its lens, its pose, and the size of its image in px."""

    intrinsics: Intrinsics
    pose: Pose
    columns: int
    rows: int


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


def common_view(first: Looking, second: Looking, points: Floats, largest_angle_rad: float) -> CommonView:
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


def _lines(camera: Looking, points: Floats) -> tuple[NDArray[np.bool_], Floats]:
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
