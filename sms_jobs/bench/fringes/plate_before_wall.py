"""A plate before a wall, seen with 8 x 8 rays a pixel: what pixels on silhouettes and rims of light show.

Plate and wall are planes, camera and projector pin-holes without lenses, so that the point of every ray, its
light and its shadow are exact. Noise is normal and is rounded with the level to whole grey levels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np
from scipy import ndimage

from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.phase.patterns import phase_gradient, stripe_brightness
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import START

RAYS = 8
"""Along each side of a pixel."""

_COLUMNS, _ROWS = 176, 144
_PROJECTOR = (800, 600)


@dataclass(frozen=True)
class EdgeScene:
    """One plate before one wall.

    Attributes
    ----------
    angle_deg
        By which the plate, a square, is turned in its plane: the direction of its edges.
    tilt_deg
        Of the plate about the world's x and y.
    depth_mm
        By which its middle stands before the wall.
    albedo
        Of plate and wall, 0 .. 1.
    speckle
        Contrast of the texture on both, 0 for none.
    blur_px
        Standard deviation of the lens's spot.
    lit_px
        Right of this column of its image the projector is dark: a rim of light.
    bits, noise
        Of the camera; the standard deviation of a frame at full scale and below, in parts of full scale.
    seed
        Of texture and noise.
    """

    angle_deg: float
    tilt_deg: tuple[float, float]
    depth_mm: float
    albedo: tuple[float, float]
    speckle: float
    blur_px: float
    lit_px: float
    bits: int
    noise: float
    seed: int


@dataclass(frozen=True)
class Seen:
    """A scene as it was recorded, and the truth.

    Attributes
    ----------
    measurement, calibration
        What `reconstruct` is given.
    point
        (2, 3, rows, columns): where the ray through the pixel's centre meets plate and wall, in mm.
    sees
        (2, rows, columns): the part of the pixel's light that comes from plate and wall.
    dark
        (rows, columns): the part of its rays that meets a point in shadow or beside the light.
    """

    measurement: Measurement
    calibration: Calibration
    point: Floats
    sees: Floats
    dark: Floats

    @property
    def mixed(self) -> Mask:
        """(rows, columns): where a thousandth of a pixel's light, or of its rays, is not like the rest."""
        return np.asarray((self.sees.min(axis=0) > 1e-3) | ((self.dark > 1e-3) & (self.dark < 1.0 - 1e-3)))

    def error(self, position: Floats) -> Floats:
        """Return the distance of points (3, rows, columns) from the nearer of the surfaces that are seen, mm.

        Of the point on each that the pixel's centre ray meets. NaN where nothing is seen.
        """
        away = np.linalg.norm(position - self.point, axis=1)
        away[self.sees <= 0.0] = np.inf
        return np.asarray(np.where(np.isfinite(position[0]), away.min(axis=0), np.nan))


def random_scene(random: np.random.Generator) -> EdgeScene:
    """Draw a scene: edges at any angle, a step of 3 to 150 mm, a camera of 8 or 12 bits."""
    return EdgeScene(
        float(random.uniform(0.0, 90.0)),
        (float(random.uniform(-25.0, 25.0)), float(random.uniform(-25.0, 25.0))),
        float(np.exp(random.uniform(np.log(3.0), np.log(150.0)))),
        (float(random.uniform(0.2, 1.0)), float(random.uniform(0.2, 1.0))),
        float(random.choice([0.0, 0.6])),
        float(random.uniform(0.0, 0.7)),
        float(random.uniform(380.0, 480.0)),
        int(random.choice([8, 12])),
        float(random.uniform(0.002, 0.008)),
        int(random.integers(1 << 31)),
    )


def rig() -> Calibration:
    """Return the camera and the projector, 0.6 m apart at 1 m from the wall."""
    up = np.array([0.0, 1.0, 0.0])
    target = np.array([0.0, 0.0, 0.0])
    camera = Sensor(
        "C1",
        Role.CAMERA,
        _COLUMNS,
        _ROWS,
        Intrinsics(1500.0, 1500.0, 0.5 * (_COLUMNS - 1), 0.5 * (_ROWS - 1)),
        Pose.looking_at(np.array([-200.0, 30.0, 1000.0]), target, up),
    )
    columns, rows = _PROJECTOR
    projector = Sensor(
        "P1",
        Role.PROJECTOR,
        columns,
        rows,
        Intrinsics(1900.0, 1900.0, 0.5 * (columns - 1), 0.5 * (rows - 1)),
        Pose.looking_at(np.array([200.0, -40.0, 1000.0]), target, up),
    )
    volume = Box((-200.0, -200.0, -200.0), (200.0, 200.0, 300.0))
    return Calibration(Rig("edges", (camera, projector)), volume, START, "exact parameters of the scene")


def _plate(scene: EdgeScene) -> tuple[Floats, Floats]:
    """Return the plate's middle and its axes, rows of a (3, 3) array, the last its normal."""
    x, y = (radians(a) for a in scene.tilt_deg)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos(x), -sin(x)], [0.0, sin(x), cos(x)]])
    about_y = np.array([[cos(y), 0.0, sin(y)], [0.0, 1.0, 0.0], [-sin(y), 0.0, cos(y)]])
    turn = radians(scene.angle_deg)
    about_z = np.array([[cos(turn), -sin(turn), 0.0], [sin(turn), cos(turn), 0.0], [0.0, 0.0, 1.0]])
    return np.array([0.0, 0.0, scene.depth_mm]), (about_y @ about_x @ about_z).T


def _meet(start: Floats, ray: Floats, middle: Floats, normal: Floats) -> Floats:
    """Return where rays (..., 3) from a point meet a plane, (..., 3)."""
    return np.asarray(start + ray * ((middle - start) @ normal / (ray @ normal))[..., None])


def _on_plate(point: Floats, middle: Floats, axes: Floats, half_mm: float) -> Mask:
    own = (point - middle) @ axes[:2].T
    return np.asarray(np.abs(own).max(axis=-1) <= half_mm)


def _texture(own: Floats, contrast: float, random: np.random.Generator) -> Floats:
    """Return the brightness, 1 - contrast .. 1, of waves of 2 to 6 mm at points (..., 2) in mm."""
    if contrast == 0.0:
        return np.ones(own.shape[:-1])
    total = np.zeros(own.shape[:-1])
    for _ in range(8):
        turn, wave, start = random.uniform(0.0, pi), random.uniform(2.0, 6.0), random.uniform(0.0, 2.0 * pi)
        total += np.sin((own[..., 0] * cos(turn) + own[..., 1] * sin(turn)) * (2.0 * pi / wave) + start)
    return np.asarray(1.0 - 0.5 * contrast * (1.0 + np.tanh(total)))


def _pixels(fine: Floats, blur_px: float) -> Floats:
    """Blur an image of rays and average it over the pixels."""
    if blur_px > 0.0:
        fine = ndimage.gaussian_filter(fine, blur_px * RAYS, mode="nearest", truncate=4.0)
    rows, columns = fine.shape
    return np.asarray(fine.reshape(rows // RAYS, RAYS, columns // RAYS, RAYS).mean(axis=(1, 3)))


def _doubled(
    sequence: FringeSequence, xy: Floats, projector: Sensor, shown: Floats, blur_px: float
) -> Iterator[Floats]:
    """Yield twice the projector's light in each frame, (rows, columns), of rays that are lit at `xy`."""
    mean = _pixels(shown, blur_px)
    found: tuple[tuple[float, float], Floats, Floats] | None = None
    for orientation, density, step in sequence.patterns():
        if found is None or found[0] != (orientation, density):
            phase = density * phase_gradient(xy, projector.columns, projector.rows, orientation)
            cosine, sine = (_pixels(shown * f(phase), blur_px) for f in (np.cos, np.sin))
            found = ((orientation, density), cosine, sine)
        turn = 2.0 * pi * step / sequence.steps
        yield mean + cos(turn) * found[1] - sin(turn) * found[2]
    for one in sequence.code_patterns():
        omega = phase_gradient(xy, projector.columns, projector.rows, one.orientation_rad)
        bright = stripe_brightness(omega, one.bits, one.stripes, one.bit, one.inverted)
        yield 2.0 * _pixels(shown * bright, blur_px)


def record(scene: EdgeScene, sequence: FringeSequence) -> Seen:
    """Record a scene with a sequence; the noise that the measurement states is the true one."""
    random = np.random.default_rng(scene.seed)
    calibration = rig()
    camera, projector = calibration.rig.sensor("C1"), calibration.rig.sensor("P1")
    middle, axes = _plate(scene)
    wall, towards = np.zeros(3), np.array([0.0, 0.0, 1.0])
    start, light = camera.pose.centre(), projector.pose.centre()
    half_mm = 25.0

    def points(pixels: Floats) -> tuple[Floats, Floats]:
        rays = ray_directions(camera.intrinsics, camera.pose, pixels)
        return _meet(start, rays, middle, axes[2]), _meet(start, rays, wall, towards)

    x = (np.arange(_COLUMNS * RAYS) + 0.5) / RAYS - 0.5
    y = (np.arange(_ROWS * RAYS) + 0.5) / RAYS - 0.5
    near, far = points(np.stack(np.meshgrid(x, y), axis=-1))
    front = _on_plate(near, middle, axes, half_mm)
    point = np.where(front[..., None], near, far)
    shadow = ~front & _on_plate(_meet(light, point - light, middle, axes[2]), middle, axes, half_mm)
    xy = project(projector.intrinsics, projector.pose, point)
    lit = ~shadow & (xy[..., 0] < scene.lit_px)
    own = np.where(front[..., None], (near - middle) @ axes[:2].T, far[..., :2] + 500.0)
    strength = np.where(front, *scene.albedo) * _texture(own, scene.speckle, random)
    shown = strength * lit
    ambient = 0.03 * _pixels(strength, scene.blur_px)
    mean = _pixels(shown, scene.blur_px)
    full_scale = 2**scene.bits - 1
    levels = (ambient + 0.5 * light for light in _doubled(sequence, xy, projector, shown, scene.blur_px))
    frames = np.empty((sequence.frames, _ROWS, _COLUMNS), np.uint16)
    for index, level in enumerate(levels):
        noisy = 0.85 * level + scene.noise * random.standard_normal(level.shape)
        frames[index] = np.clip(np.rint(full_scale * noisy), 0, full_scale)
    parts = np.stack([_pixels(shown * front, scene.blur_px), _pixels(shown * ~front, scene.blur_px)])
    centres = np.stack(np.meshgrid(np.arange(_COLUMNS, dtype=np.float64), np.arange(float(_ROWS))), axis=-1)
    measurement = Measurement(
        START,
        sequence,
        full_scale,
        0.0,
        float(np.hypot(full_scale * scene.noise, 12.0**-0.5)),
        np.clip(np.rint(full_scale * 0.85 * (ambient + mean)), 0, full_scale).astype(np.uint16),
        ArrayStack(frames),
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        sees = np.nan_to_num(parts / parts.sum(axis=0))
    return Seen(
        measurement,
        calibration,
        np.stack([np.moveaxis(p, -1, 0) for p in points(centres)]),
        sees,
        _pixels((~lit).astype(np.float64), scene.blur_px),
    )


def reconstructed(seen: Seen, parameters: ReconstructParameters) -> Surface:
    """Return the surface that `reconstruct` finds."""
    records = {"measurement": seen.measurement, "calibration": seen.calibration}
    output = run_kind(KIND, Subject("edges", "S00", "C1P1"), records, 1, parameters)
    surface = output.records["surface"]
    assert isinstance(surface, Surface)
    return surface
