"""The scalar camera model of the renderer is the camera model of the metrology."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sms_jobs.metrology.geometry.camera import project, ray_directions
from sms_jobs.metrology.geometry.lens import PIN_HOLE, Intrinsics
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, aimed
from sms_jobs.virtual_rig.optics import image_point, in_image, packed_sensor, pixel_ray

AIMED = aimed("C1", 512, 400, CAMERA_LENS, (-900.0, 300.0, 2000.0), 0.1)
LENS = AIMED.intrinsics.vector()
LENS[PIN_HOLE:] += 0.001 * np.arange(1, len(LENS) - PIN_HOLE + 1)
SENSOR = replace(AIMED, intrinsics=Intrinsics.from_vector(LENS))
"""With some of every coefficient of the distortion."""


def test_rays_are_the_camera_models(rng: np.random.Generator) -> None:
    packed = packed_sensor(SENSOR)
    pixels = rng.uniform(-0.5, 511.5, (100, 2))
    expected = ray_directions(SENSOR.intrinsics, SENSOR.pose, pixels)
    for pixel, direction in zip(pixels, expected, strict=True):
        found = pixel_ray(packed, *pixel, 0.3, -0.2)[:3]  # a poor start makes no difference
        np.testing.assert_allclose(found, direction, atol=1e-14)


def test_image_points_are_the_camera_models(rng: np.random.Generator) -> None:
    packed = packed_sensor(SENSOR)
    points = rng.uniform(-300.0, 300.0, (100, 3))
    expected = project(SENSOR.intrinsics, SENSOR.pose, points)
    found = [image_point(packed, *point) for point in points]
    # A dozen roundings of numbers up to 1000 px.
    np.testing.assert_allclose(found, expected, atol=1e-11)


def test_nothing_is_imaged_behind_the_sensor_or_beyond_its_edge() -> None:
    packed = packed_sensor(SENSOR)
    behind = SENSOR.pose.centre() * 1.5
    assert np.isnan(image_point(packed, *behind)).all()
    assert in_image(packed, -0.5, 399.5)
    assert not in_image(packed, -0.51, 10.0)
    assert not in_image(packed, np.nan, 10.0)
