"""What blur does to the phase on a sphere is taken back."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.targets.sphere_blur import blur_shift, sphere_image_in_projector
from sms_jobs.virtual_rig.campaigns import top_hat_bending

RIG = top_hat_bending("blur", "small")[0].rig
CAMERA, PROJECTOR = RIG.sensor("C1"), RIG.sensor("P2")
C = (CAMERA.intrinsics, CAMERA.pose)
P = (PROJECTOR.intrinsics, PROJECTOR.pose)
CENTRE, RADIUS = np.array([20.0, -30.0, 10.0]), 25.0


def pixels_on_the_sphere(radius_px: float) -> np.ndarray:
    middle = np.array([CAMERA.intrinsics.cx, CAMERA.intrinsics.cy])
    inside = CAMERA.pose.matrix() @ CENTRE + np.array(CAMERA.pose.translation)
    middle = middle + CAMERA.intrinsics.fx * inside[:2] / inside[2]
    x, y = np.meshgrid(*2 * [np.arange(-20.0, 20.5, 2.0)])
    offsets = np.stack([x, y], axis=-1).reshape(-1, 2)
    return middle + offsets[np.hypot(*offsets.T) < radius_px]


def test_points_on_the_sphere_are_seen_where_both_rays_meet() -> None:
    pixels = pixels_on_the_sphere(12.0)
    seen = sphere_image_in_projector(C, P, CENTRE, RADIUS, pixels)
    assert np.isfinite(seen).all()
    # Beyond the limb, 20 px at 0.79 px/mm, there is nothing to see.
    assert np.isnan(sphere_image_in_projector(C, P, CENTRE, RADIUS, pixels + 60.0)).all()


def test_the_shift_is_that_of_a_weighted_mean_over_the_spot() -> None:
    pixels = pixels_on_the_sphere(9.0)
    blur, slope = 0.6, np.array([0.05, -0.03])
    # The mean of x(u) over a normal spot with weights exp(slope . u), by a fine grid out to five deviations.
    x, y = np.meshgrid(*2 * [np.linspace(-5.0 * blur, 5.0 * blur, 101)])
    offsets = np.stack([x, y], axis=-1).reshape(-1, 1, 2)
    weight = np.exp(-0.5 * np.sum(offsets**2, axis=-1) / blur**2 + offsets @ slope)
    spread = sphere_image_in_projector(C, P, CENTRE, RADIUS, pixels + offsets)
    mean = np.sum(weight[..., None] * spread, axis=0) / weight.sum(axis=0)[..., None]
    exact = mean - sphere_image_in_projector(C, P, CENTRE, RADIUS, pixels)
    found = blur_shift(C, P, CENTRE, RADIUS, pixels, np.broadcast_to(slope, pixels.shape), blur)
    # The next order is blur^4 times the fourth derivative: on a sphere of r pixels about (blur / r)^2 of the
    # shift, 0.1 % in the middle, several times that at 9 of 20 px from it.
    np.testing.assert_allclose(found, exact, atol=0.01 * np.abs(exact).max())
    # And it matters: a hundredth of a pixel, several times the deviation of the sphere's centre.
    assert np.abs(exact).max() > 0.01


def test_no_blur_is_no_shift() -> None:
    pixels = pixels_on_the_sphere(9.0)
    found = blur_shift(C, P, CENTRE, RADIUS, pixels, np.zeros(pixels.shape), 0.0)
    np.testing.assert_array_equal(found, 0.0)
