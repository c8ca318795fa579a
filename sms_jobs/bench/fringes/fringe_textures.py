"""A plate with a texture, seen through pixels of any blur, with 8 x 8 rays a pixel and the exact truth."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, radians, sin, tan
from typing import Literal, TypeAlias

import numpy as np
from scipy import ndimage

from sms_jobs.bench.fringes.bent_waveforms import Recording
from sms_jobs.bench.fringes.plate_before_wall import RAYS, rig
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import project, ray_directions
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.virtual_rig.campaigns import START

Pattern: TypeAlias = Literal["plain", "waves", "speckle", "squares"]

_FULL_SCALE = 4095
_MARGIN = 4  # pixels beyond the image, for the lens's spot
_CONTRAST = 5.0
_WAVES_MM: dict[Pattern, tuple[float, float]] = {"waves": (20.0, 40.0), "speckle": (2.0, 6.0)}


@dataclass(frozen=True)
class TexturedPlate:
    """What is recorded.

    Attributes
    ----------
    pattern
        Nothing, waves of 20 to 40 mm, waves of 2 to 6 mm, or squares at random in two tones, 5 : 1; a pixel
        is 0.67 mm.
    square_mm
        Size of the squares.
    blur_px
        Standard deviation of the lens's spot; 0 for that of the pixel alone, a box.
    noise
        Standard deviation of a frame in parts of full scale.
    """

    pattern: Pattern
    square_mm: float
    blur_px: float
    noise: float


def _texture(plate: TexturedPlate, own: Floats, random: np.random.Generator) -> Floats:
    """Return the brightness, up to 1, at points (..., 2) in mm."""
    if plate.pattern == "plain":
        return np.ones(own.shape[:-1])
    if plate.pattern == "squares":
        turn = random.uniform(0.0, 0.5 * pi)
        tones = random.integers(0, 2, (256, 256))
        across = own[..., 0] * cos(turn) + own[..., 1] * sin(turn)
        along = own[..., 1] * cos(turn) - own[..., 0] * sin(turn)
        x, y = (np.floor(v / plate.square_mm).astype(int) % 256 for v in (across, along))
        return np.where(tones[y, x] == 1, 1.0, 1.0 / _CONTRAST)
    total = np.zeros(own.shape[:-1])
    for _ in range(8):
        turn, wave = random.uniform(0.0, pi), random.uniform(*_WAVES_MM[plate.pattern])
        total += np.sin((own @ (cos(turn), sin(turn))) * (2.0 * pi / wave) + random.uniform(0.0, 2.0 * pi))
    return np.asarray(1.0 - 0.35 * (1.0 + np.tanh(total)))


def _pixels(fine: Floats, blur_px: float) -> Floats:
    """Blur an image of rays, cut off its margin and average it over the pixels."""
    if blur_px > 0.0:
        fine = ndimage.gaussian_filter(fine, blur_px * RAYS, truncate=4.0)
    edge = _MARGIN * RAYS
    fine = fine[edge:-edge, edge:-edge]
    rows, columns = fine.shape
    return np.asarray(fine.reshape(rows // RAYS, RAYS, columns // RAYS, RAYS).mean(axis=(1, 3)))


def record(random: np.random.Generator, plate: TexturedPlate, sequence: FringeSequence) -> Recording:
    """Record a plate; its tilt and its texture are drawn."""
    calibration = rig()
    camera, projector = calibration.rig.sensor("C1"), calibration.rig.sensor("P1")
    normal = np.array([*(tan(radians(random.uniform(-25.0, 25.0))) for _ in range(2)), 1.0])
    start = camera.pose.centre()

    def points(x: Floats, y: Floats) -> Floats:
        rays = ray_directions(camera.intrinsics, camera.pose, np.stack(np.meshgrid(x, y), axis=-1))
        return np.asarray(start + rays * (-(start @ normal) / (rays @ normal))[..., None])

    x, y = (
        (np.arange((n + 2 * _MARGIN) * RAYS) + 0.5) / RAYS - 0.5 - _MARGIN
        for n in (camera.columns, camera.rows)
    )
    fine = points(x, y)
    xy = project(projector.intrinsics, projector.pose, fine)
    strength = random.uniform(0.6, 0.85) * _texture(plate, fine[..., :2], random)
    mean = _pixels(strength, plate.blur_px)
    frames = np.empty((sequence.frames, camera.rows, camera.columns), np.uint16)
    shown: tuple[tuple[float, float], Floats, Floats] | None = None
    for index, (orientation, density, step) in enumerate(sequence.patterns()):
        if shown is None or shown[0] != (orientation, density):
            phase = density * phase_gradient(xy, projector.columns, projector.rows, orientation)
            cosine, sine = (_pixels(strength * f(phase), plate.blur_px) for f in (np.cos, np.sin))
            shown = ((orientation, density), cosine, sine)
        turn = 2.0 * pi * step / sequence.steps
        level = 0.53 * mean + 0.5 * (cos(turn) * shown[1] - sin(turn) * shown[2])
        noisy = _FULL_SCALE * (level + plate.noise * random.standard_normal(level.shape))
        frames[index] = np.clip(np.rint(noisy), 0, _FULL_SCALE)
    measurement = Measurement(
        START,
        sequence,
        _FULL_SCALE,
        0.0,
        float(np.hypot(_FULL_SCALE * plate.noise, 12.0**-0.5)),
        np.rint(_FULL_SCALE * mean).astype(np.uint16),
        ArrayStack(frames),
    )
    point = points(np.arange(float(camera.columns)), np.arange(float(camera.rows)))
    return Recording(measurement, calibration, np.moveaxis(point, -1, 0))
