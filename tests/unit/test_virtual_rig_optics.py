"""The scalar camera model of the renderer is the camera model of the metrology."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.metrology.geometry.camera import project, ray_directions
from sms_jobs.metrology.geometry.lens import LENS, MODELS, PIN_HOLE, Intrinsics, Model, foreign
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, aimed
from sms_jobs.virtual_rig.optics import image_point, in_image, packed_sensor, pixel_ray

AIMED = aimed("C1", 512, 400, CAMERA_LENS, (-900.0, 300.0, 2000.0), 0.1)


def bent(model: Model) -> Sensor:
    """Return the sensor with some of every coefficient of a model."""
    lens = AIMED.intrinsics.vector()
    lens[PIN_HOLE:] += 0.001 * np.arange(1, len(lens) - PIN_HOLE + 1)
    lens[[name in foreign(model) for name in LENS]] = 0.0
    found = replace(Intrinsics.from_vector(lens), fisheye=float(model == "fisheye"))
    if model != "plain":
        found = replace(found, fx=0.4 * found.fx / 3.85, fy=0.4 * found.fy / 3.85)
    return replace(AIMED, intrinsics=found)


SENSORS = {model: bent(model) for model in MODELS}
SENSOR = SENSORS["plain"]


@pytest.mark.parametrize("model", MODELS)
def test_rays_are_the_camera_models(model: Model, rng: np.random.Generator) -> None:
    sensor = SENSORS[model]
    packed = packed_sensor(sensor)
    pixels = rng.uniform(-0.5, 511.5, (100, 2))
    expected = ray_directions(sensor.intrinsics, sensor.pose, pixels)
    for pixel, direction in zip(pixels, expected, strict=True):
        found = pixel_ray(packed, *pixel, 0.3, -0.2)[:3]  # a poor start makes no difference
        np.testing.assert_allclose(found, direction, atol=1e-14)


@pytest.mark.parametrize("model", MODELS)
def test_image_points_are_the_camera_models(model: Model, rng: np.random.Generator) -> None:
    sensor = SENSORS[model]
    packed = packed_sensor(sensor)
    points = rng.uniform(-300.0, 300.0, (100, 3)) * (1.0 if model == "plain" else 4.0)
    expected = project(sensor.intrinsics, sensor.pose, points)
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
