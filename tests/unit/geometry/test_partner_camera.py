"""Points on a camera's rays from where a second camera sees them."""

from __future__ import annotations

from math import radians

import numpy as np

from sms_jobs.metrology.geometry.camera import project, ray_directions
from sms_jobs.metrology.geometry.partner_camera import meet_places
from sms_jobs.virtual_rig.stereo_campaigns import WIDE_ANGLE, stereo_rig

FIRST, SECOND = stereo_rig(lens=WIDE_ANGLE, angle_rad=radians(25.0)).sensors
PARTNER = (SECOND.intrinsics, SECOND.pose)


def test_exact_places_give_exact_points_and_gaps_are_told_across_the_rays(rng: np.random.Generator) -> None:
    points = rng.uniform([-150.0, -120.0, -40.0], [150.0, 120.0, 40.0], (300, 3))
    rays = ray_directions(FIRST.intrinsics, FIRST.pose, project(FIRST.intrinsics, FIRST.pose, points))
    place = project(*PARTNER, points).T
    met = meet_places(FIRST.pose.centre(), rays, PARTNER, place)
    # Undistortion is iterated to 1e-10 of a focal length of 640 px.
    np.testing.assert_allclose(met.xyz.T, points, atol=1e-5)
    assert float(np.abs(met.gap).max()) < 1e-5
    for axis in range(2):
        beside = place.copy()
        beside[axis] += 0.01
        moved = meet_places(FIRST.pose.centre(), rays, PARTNER, beside)
        depth = np.sum((moved.xyz - met.xyz) * rays.T, axis=0)
        # A hundredth of a pixel bends the way by a ten-thousandth of itself.
        np.testing.assert_allclose(depth / 0.01, met.depth_by_place[axis], rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose((moved.gap - met.gap) / 0.01, met.gap_by_place[axis], atol=1e-3)
    # Across the image of the ray, depth is not told at all.
    across = np.sum(met.gap_by_place * met.depth_by_place, axis=0)
    assert float(np.abs(across).max()) < 1e-9


def test_rays_that_part_have_no_point() -> None:
    # C1 stands on the left and looks to its left, C2 on the right and to its right.
    rays = ray_directions(FIRST.intrinsics, FIRST.pose, np.array([[10.0, 256.0]]))
    parting = meet_places(FIRST.pose.centre(), rays, PARTNER, np.array([[620.0], [256.0]]))
    meeting = meet_places(FIRST.pose.centre(), rays, PARTNER, np.array([[10.0], [256.0]]))
    nowhere = meet_places(FIRST.pose.centre(), rays, PARTNER, np.full((2, 1), np.nan))
    assert np.isfinite(meeting.xyz).all()
    assert np.isnan(parting.xyz).all()
    assert np.isnan(nowhere.xyz).all()
