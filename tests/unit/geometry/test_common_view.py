"""What two cameras see together of a volume."""

from __future__ import annotations

from dataclasses import replace
from math import isnan, radians

import numpy as np
import pytest

from sms_jobs.metrology.geometry.camera import Camera, Pose
from sms_jobs.metrology.geometry.common_view import common_view, sees_some_of
from sms_jobs.metrology.geometry.lens import Intrinsics

LENS = Intrinsics(fx=1000.0, fy=1000.0, cx=49.5, cy=49.5)
"""At 1000 mm a pixel is 1 mm: 100 x 100 mm are seen."""
LINE = np.stack([np.arange(-99.0, 100.0, 2.0), np.zeros(100), np.zeros(100)], axis=-1)


def looking(degrees: float = 0.0, x: float = 0.0) -> Camera:
    """Return a camera that looks at (x, 0, 0) from so many degrees beside -z."""
    at = np.array([x + 1000.0 * np.sin(radians(degrees)), 0.0, -1000.0 * np.cos(radians(degrees))])
    pose = Pose.looking_at(at, np.array([x, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]))
    return Camera(LENS, pose, 100, 100)


def test_fields_of_view_overlap_by_what_both_see() -> None:
    found = common_view(looking(), looking(x=30.0), LINE, radians(75.0))
    # The one sees x from -50 to 50, the other from -20 to 80: 35 of 100 points.
    assert found.seen == found.usable == pytest.approx(0.35)
    assert found.least_angle_rad == pytest.approx(0.03, rel=1e-2)


def test_a_box_is_seen_whether_it_is_smaller_or_larger_than_the_image() -> None:
    """At 1000 mm the image is 100 mm wide, so that it ends at 50 mm."""
    camera = looking()

    def seen(middle: tuple[float, float, float], half: float) -> bool:
        return sees_some_of(camera, np.array(middle) - half, np.array(middle) + half)

    assert seen((0.0, 0.0, 0.0), 1e-3)
    assert seen((49.0, 0.0, 0.0), 1e-3)
    assert not seen((51.0, 0.0, 0.0), 1e-3)
    # Around the camera: of points 2500 mm apart none is in the image, which is 1 m wide at the far side.
    assert seen((1250.0, 1250.0, -1000.0), 1e4)
    assert not seen((1200.0, 0.0, 0.0), 1e3)
    assert not seen((0.0, 0.0, -2100.0), 1e3)


def test_lines_of_sight_may_differ_too_much() -> None:
    origin = np.zeros((1, 3))
    found = common_view(looking(), looking(80.0), origin, radians(75.0))
    assert (found.seen, found.usable) == (1.0, 0.0)
    assert found.least_angle_rad == pytest.approx(radians(80.0))
    assert common_view(looking(), looking(70.0), origin, radians(75.0)).usable == 1.0


def test_cameras_that_look_elsewhere_see_nothing_together() -> None:
    found = common_view(looking(), looking(x=120.0), LINE, radians(75.0))
    assert (found.seen, found.usable) == (0.0, 0.0)
    assert isnan(found.least_angle_rad)
    # Behind a camera its pin-hole model has an image too.
    behind = LINE + np.array([0.0, 0.0, -2000.0])
    assert common_view(looking(), looking(), behind, radians(75.0)).seen == 0.0


def test_what_a_lens_folds_back_is_not_seen() -> None:
    # x (1 - 2 x^2) comes back to the image's middle at x = 0.707.
    folding = replace(looking(), intrinsics=replace(LENS, k1=-2.0))
    far = np.array([[700.0, 0.0, 0.0]])
    assert common_view(folding, folding, far, radians(75.0)).seen == 0.0
    assert common_view(folding, folding, np.zeros((1, 3)), radians(75.0)).seen == 1.0
