"""Whether a calibration still holds, from the ray gap of a measurement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.calibration.sensor_derivatives import gap_derivatives
from sms_jobs.metrology.geometry.camera import Intrinsics, Pose, project, ray_directions
from sms_jobs.metrology.geometry.transforms import rotation_matrix

Floats = NDArray[np.float64]
Sensor = tuple[Intrinsics, Pose]

DOWN = np.array([0.0, -1.0, 0.0])
CAMERA: Sensor = (
    Intrinsics(1500.0, 1500.0, 511.5, 383.5, -0.1, 0.05),
    Pose.looking_at(np.array([-300.0, 0.0, -1000.0]), np.zeros(3), DOWN),
)
PROJECTOR: Sensor = (
    Intrinsics(1400.0, 1405.0, 500.0, 420.0, 0.05, -0.02, 1e-4, -2e-4),
    Pose.looking_at(np.array([300.0, 50.0, -1050.0]), np.zeros(3), DOWN),
)


def moved(sensor: Sensor, step: Floats) -> Sensor:
    """Return a sensor after a change of its 15 parameters."""
    lens, pose = sensor
    values = np.array([lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion()]) + step[6:]
    return Intrinsics(*map(float, values)), Pose.from_arrays(
        rotation_matrix(step[:3]) @ pose.matrix(), np.array(pose.translation) + step[3:6]
    )


def gaps(camera: Sensor, projector: Sensor, pixels: tuple[Floats, Floats]) -> Floats:
    """Return the signed ray gaps (n,) in mm of pixels (n, 2) of both sensors."""
    u, v = ray_directions(*camera, pixels[0]), ray_directions(*projector, pixels[1])
    normal = np.cross(u, v)
    base = projector[1].centre() - camera[1].centre()
    return np.asarray(normal @ base / np.linalg.norm(normal, axis=1))


def test_gap_derivatives_are_those_of_finite_differences(rng: np.random.Generator) -> None:
    points = rng.uniform(-150.0, 150.0, (20, 3))
    pixels = (project(*CAMERA, points), project(*PROJECTOR, points))
    found = gap_derivatives(CAMERA, PROJECTOR, points)
    for k in range(30):
        size = 1e-6 if k % 15 < 3 else 1e-3 if k % 15 < 10 else 1e-5
        step = size * np.eye(30)[k]
        up, down = (
            gaps(moved(CAMERA, s * step[:15]), moved(PROJECTOR, s * step[15:]), pixels) for s in (1, -1)
        )
        # Gaps of 1e-3 mm and more, rounding of 1e-12 mm; second-order terms cancel.
        np.testing.assert_allclose(
            found[:, k], (up - down) / (2 * size), rtol=1e-5, atol=1e-6 * abs(found[:, k]).max()
        )
