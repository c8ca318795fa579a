"""A tilted plate seen through a projector that is not linear, lit once or twice, without a blur anywhere.

Every frame is the exact level at the pixel's centre with normal noise, rounded: what is wrong of a point
comes from the waveform of the fringes alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, radians, tan
from typing import Any

import numpy as np

from sms_jobs.bench.fringes.plate_before_wall import rig
from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import project, ray_directions
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import START

_FULL_SCALE = 4095
_NEAREST_PX, _FARTHEST_PX = (40.0, 30.0), (300.0, 250.0)
"""By which the second light comes from elsewhere in the projector: from 3 bins of 64 fringes on."""


@dataclass(frozen=True)
class Recording:
    """A recording of a plate, and where its points truly are.

    Attributes
    ----------
    measurement, calibration
        What `reconstruct` is given.
    point
        (3, rows, columns), mm: where the ray through the pixel's centre meets the plate.
    """

    measurement: Measurement
    calibration: Calibration
    point: Floats


def record(
    random: np.random.Generator,
    sequence: FringeSequence,
    gamma: float,
    noise: float,
    *,
    twice: bool,
    full_scale: int = _FULL_SCALE,
) -> Recording:
    """Record a plate, of which the left two thirds are lit `twice`, or once like the rest.

    `noise` is the standard deviation of a frame in parts of full scale. The tilt of the plate, its
    brightness, from where the second light comes, and how bright it is, are drawn.
    """
    calibration = rig()
    camera, projector = calibration.rig.sensor("C1"), calibration.rig.sensor("P1")
    columns, rows = camera.columns, camera.rows
    pixels = np.stack(np.meshgrid(np.arange(float(columns)), np.arange(float(rows))), axis=-1)
    rays = ray_directions(camera.intrinsics, camera.pose, pixels)
    normal = np.array([*(tan(radians(random.uniform(-25.0, 25.0))) for _ in range(2)), 1.0])
    start = camera.pose.centre()
    point = start + rays * (-(start @ normal) / (rays @ normal))[..., None]
    direct = project(projector.intrinsics, projector.pose, point)
    share = np.linspace(0.0, 1.0, columns)[None, :, None]
    sides = random.choice([-1.0, 1.0], 2)
    away = sides * (np.array(_NEAREST_PX) * (1.0 - share) + np.array(_FARTHEST_PX) * share)
    lit_twice = twice & (pixels[..., 0] < columns * 2 // 3)
    strength = np.full((rows, columns), random.uniform(0.2, 0.45))
    second = np.where(lit_twice, strength * random.uniform(0.2, 0.9, (rows, columns)), 0.0)
    frames = np.empty((sequence.frames, rows, columns), np.uint16)
    span = (projector.columns, projector.rows)
    for index, (orientation, density, step) in enumerate(sequence.patterns()):
        turn = 2.0 * pi * step / sequence.steps
        level = np.full((rows, columns), 0.02)
        for light, xy in ((strength, direct), (second, direct + away)):
            phase = density * phase_gradient(xy, *span, orientation)
            level += light * (0.5 + 0.5 * np.cos(phase + turn)) ** gamma
        noisy = full_scale * (level + noise * random.standard_normal(level.shape))
        frames[index] = np.clip(np.rint(noisy), 0, full_scale)
    texture = np.rint(full_scale * (0.02 + strength + second)).astype(np.uint16)
    measurement = Measurement(
        START,
        sequence,
        full_scale,
        0.0,
        float(np.hypot(full_scale * noise, 12.0**-0.5)),
        texture,
        ArrayStack(frames),
    )
    return Recording(measurement, calibration, np.moveaxis(point, -1, 0))


def scores(seen: Recording, parameters: dict[str, Any]) -> tuple[Floats, float]:
    """Return error over stated deviation of all valid points, and the part of all pixels that is valid.

    Of a recording that is refused nothing is valid.
    """
    records = {"measurement": seen.measurement, "calibration": seen.calibration}
    settings = ReconstructParameters(**parameters)
    try:
        surface = run_kind(KIND, Subject("plate", "S00", "C1P1"), records, 1, settings).records["surface"]
    except MeasurementFailed:
        return np.zeros(0), 0.0
    assert isinstance(surface, Surface)
    valid = surface.reason == Reason.VALID
    error = np.linalg.norm(surface.position - seen.point, axis=0)[valid]
    sigma = np.sqrt(trace(position_covariance(surface)))[valid]
    return error / sigma, float(valid.mean())
