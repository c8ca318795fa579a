"""Whatever the lens and wherever the sensor stands, rays and projection undo each other."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics

lenses = st.builds(
    Intrinsics,
    fx=st.floats(800.0, 4000.0),
    fy=st.floats(800.0, 4000.0),
    cx=st.floats(300.0, 700.0),
    cy=st.floats(200.0, 500.0),
    k1=st.floats(-0.15, 0.15),
    k2=st.floats(-0.1, 0.1),
    p1=st.floats(-2e-3, 2e-3),
    p2=st.floats(-2e-3, 2e-3),
    k3=st.floats(-0.05, 0.05),
    skew=st.floats(-2e-3, 2e-3),
)
poses = st.builds(
    lambda x, y, z, tilt: Pose.looking_at(
        np.array([x, y, -z]), np.array([0.0, 20.0, 0.0]), np.array([tilt, -1.0, 0.1])
    ),
    st.floats(-800.0, 800.0),
    st.floats(-500.0, 500.0),
    st.floats(700.0, 2500.0),
    st.floats(-0.5, 0.5),
)


@given(lenses, poses, st.floats(0.0, 1023.0), st.floats(0.0, 767.0), st.floats(300.0, 5000.0))
def test_a_point_on_a_pixels_ray_projects_to_that_pixel(
    lens: Intrinsics, pose: Pose, x: float, y: float, distance: float
) -> None:
    ray = ray_directions(lens, pose, np.array([x, y]))
    found = project(lens, pose, pose.centre() + distance * ray)
    # Undistortion stops below 1e-9 focal lengths: 4e-6 px for the longest lens here.
    np.testing.assert_allclose(found, [x, y], atol=1e-5)


@given(poses)
def test_a_rotation_is_a_rotation_and_the_target_lies_ahead(pose: Pose) -> None:
    r = pose.matrix()
    # A handful of roundings.
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(r) > 0.0
    ahead = r @ np.array([0.0, 20.0, 0.0]) + pose.translation
    np.testing.assert_allclose(ahead[:2], 0.0, atol=1e-9)
    assert ahead[2] > 0.0
