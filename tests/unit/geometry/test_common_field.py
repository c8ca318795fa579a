"""The box that cameras see together, where it can be worked out by hand."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.geometry.camera import Camera, Pose
from sms_jobs.metrology.geometry.common_view import common_field
from sms_jobs.metrology.geometry.lens import Intrinsics

Floats = NDArray[np.float64]

LENS = Intrinsics(1000.0, 1000.0, 99.5, 49.5)
"""Of an image of 200 x 100 px, whose half is 0.1 x 0.05 of the distance."""


def view(*centre: float, target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Camera:
    pose = Pose.looking_at(np.array(centre), np.array(target), np.array([0.0, 1.0, 0.0]))
    return Camera(LENS, pose, 200, 100)


def test_two_cameras_at_right_angles_see_a_box() -> None:
    found = common_field([view(0.0, 0.0, -1000.0), view(1000.0, 0.0, 0.0)])
    assert found is not None
    # Each sees 100 mm to the sides and 50 mm up at 1000 mm, 5 % more behind; the box ends at whole 10 mm, and
    # is found on a grid of 41 points over 224 mm.
    for corner, sign in zip(found, (-1.0, 1.0), strict=True):
        assert np.all((sign * corner >= [100.0, 50.0, 100.0]) & (sign * corner <= [120.0, 70.0, 120.0]))


def test_the_box_moves_with_the_cameras() -> None:
    here = common_field([view(0.0, 0.0, -1000.0), view(300.0, 0.0, -900.0)])
    off = (5000.0, -3000.0, 700.0)
    there = common_field(
        [view(5000.0, -3000.0, -300.0, target=off), view(5300.0, -3000.0, -200.0, target=off)]
    )
    assert here is not None
    assert there is not None
    # Points on the edge of an image fall on either side of it by rounding, and the box ends at whole 10 mm.
    np.testing.assert_allclose(np.array(there) - off, here, atol=10.0 + 1e-6)


def test_cameras_that_look_at_no_place_see_no_box() -> None:
    first = view(0.0, 0.0, -1000.0)
    assert common_field([first, view(100.0, 0.0, -1000.0, target=(100.0, 0.0, 0.0))]) is None  # parallel
    assert common_field([first, view(100.0, 0.0, -1000.0, target=(200.0, 0.0, 0.0))]) is None  # away
    assert (
        common_field([first, view(1000.0, 900.0, 0.0, target=(0.0, 900.0, 0.0))]) is None
    )  # past each other
