"""Points of a camera's rays from the places at which a second camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.checking.expected_gap import pixel_size
from sms_jobs.metrology.geometry.camera import Pose, project, projection_jacobian, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics

_STEPS = 2
"""From the closest approach of the rays to the closest in the image; each squares what is left of a gap."""


@dataclass(frozen=True)
class MetPlaces:
    """Points of n rays of a camera; NaN where the second camera sees them nowhere, or behind a camera.

    Attributes
    ----------
    xyz
        (3, n) in mm, on the camera's rays.
    gap
        (n,) in px: how far beside the image of its ray the second camera sees a point.
    depth_by_place, gap_by_place
        (2, n), how distances along the rays, in mm/px, and gaps move with places.
    pixel_mm
        (n,), the width that a pixel of the second camera has at a point.
    """

    xyz: Floats
    gap: Floats
    depth_by_place: Floats
    gap_by_place: Floats
    pixel_mm: Floats


def meet_places(centre: Floats, rays: Floats, partner: tuple[Intrinsics, Pose], place: Floats) -> MetPlaces:
    """Find the points of rays of a camera from where a second camera sees them.

    Parameters
    ----------
    centre, rays
        Pin-hole of the camera in mm, (3,), and unit directions in the world, (n, 3).
    partner
        The second camera.
    place
        (2, n), where it sees the points, in px; NaN where it does not.

    Notes
    -----
    The depth is that whose image is the nearest to the place. With s = d(image)/d(depth) it moves by
    s / s^2 for each px of the place, and the gap by the unit vector across s. Both directions of the image
    count alike, as they do for what the calibration adds.
    """
    inner, pose = partner
    base = pose.centre() - centre
    other = ray_directions(inner, pose, place.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.cross(rays, other)
        along = np.sum(np.cross(base, other) * normal, axis=1) / np.sum(normal * normal, axis=1)
        before_both = (along > 0.0) & (np.sum(np.cross(base, rays) * normal, axis=1) > 0.0)
        along = np.where(before_both, along, np.nan)
        for step in range(_STEPS + 1):
            points = centre + along[:, None] * rays
            slope = np.einsum("nij,nj->ni", projection_jacobian(inner, pose, points), rays)
            square = np.sum(slope * slope, axis=1)
            off = place.T - project(inner, pose, points)
            if step < _STEPS:
                along = along + np.sum(slope * off, axis=1) / square
        across = np.stack([-slope[:, 1], slope[:, 0]]) / np.sqrt(square)
        by_place = slope.T / square
    return MetPlaces(
        np.ascontiguousarray(points.T),
        np.sum(across * off.T, axis=0),
        by_place,
        across,
        pixel_size(partner, points),
    )
