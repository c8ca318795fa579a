"""A calibration session made of exact geometry and noise: a ball bar in the thesis's poses, and boards.

No images are rendered: what cameras and projectors would have measured is computed, so that hundreds of
sessions can be made for figures about the adjustment alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.problem import (
    BarPoints,
    BarPose,
    BoardPoints,
    BoardPose,
    BundleBar,
    BundleBoard,
    BundleProblem,
    BundleSensor,
)
from sms_jobs.metrology.geometry.camera import Pose, project, ray_directions
from sms_jobs.metrology.geometry.lens import PER_LENS, PIN_HOLE, Intrinsics
from sms_jobs.metrology.geometry.transforms import transform
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.views import Role
from sms_jobs.virtual_rig.campaigns import top_hat_bending

TABLE_3 = tuple(
    (pan, tilt) for tilt in (-45.0, -22.5, 0.0, 22.5, 45.0) for pan in (-45.0, -22.5, 0.0, 22.5, 45.0)
)
"""Pan and tilt in degrees of the thesis's 25 poses (Table 3)."""

_STALK_MM = 60.0
_LEAST_FACING = 0.35
"""Cosine between ray and surface above which a point of a sphere is measured."""


@dataclass(frozen=True)
class SessionDesign:
    """What a session is like.

    Attributes
    ----------
    angles
        (pan, tilt) in degrees of each bar pose.
    points
        On each sphere, for each view.
    camera_pixels
        Width and height of the cameras' images.
    phase_sigma_px, dot_sigma_px
        Noise of the projector's pixels on spheres, and of dots in all images.
    length_mm, length_sigma_mm, radius_mm, radius_sigma_mm
        Of the bar.
    board_tilts
        Rotation vectors in rad of the board poses; the first is the world.
    pitch_relative_sigma, point_sigma_mm
        Of the board.
    start
        How far the start is from the truth, in units of 1e-3 rad, 2 mm, 0.3 % of the focal length, 3 px of
        the principal point, and 0.02 of the first two coefficients of the distortion.
    """

    angles: tuple[tuple[float, float], ...] = TABLE_3
    points: int = 500
    camera_pixels: int = 1024
    phase_sigma_px: float = 0.05
    dot_sigma_px: float = 0.02
    length_mm: float = 500.0
    length_sigma_mm: float = 0.002
    radius_mm: float = 30.0
    radius_sigma_mm: float = 0.002
    board_tilts: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)
    pitch_relative_sigma: float = 1e-4
    point_sigma_mm: float = 0.002
    start: float = 1.0


MANY_SESSIONS = SessionDesign(
    points=60, camera_pixels=512, angles=TABLE_3[::2], board_tilts=((0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
)
"""What is calibrated again and again."""


@dataclass(frozen=True)
class BarSession:
    """A problem, and what is true of it.

    Attributes
    ----------
    problem
        To be adjusted.
    sensors
        As they are.
    centres
        (bar poses, 2, 3) in mm.
    """

    problem: BundleProblem
    sensors: tuple[Sensor, ...]
    centres: Floats


def sphere_centres(pan_deg: float, tilt_deg: float, length_mm: float) -> Floats:
    """Return both centres (2, 3) in the world of a pose of the bar.

    Thesis Eq. (2.2), (2.3); the pan axis points to the sensors, the tilt axis to the right, and the bar
    stands upright at home.
    """
    pan, tilt = np.radians([pan_deg, tilt_deg])
    turn = Rotation.from_euler("x", pan) * Rotation.from_euler("y", tilt)
    own = np.array([[_STALK_MM, 0.0, -0.5 * length_mm], [_STALK_MM, 0.0, 0.5 * length_mm]])
    # Tripod x -> world Z, y -> X, z -> Y.
    return np.asarray(turn.apply(own)[:, [1, 2, 0]])


def seen_on_sphere(
    camera: Sensor, projector: Sensor, sphere: Floats, most: int, random: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return camera pixels (n, 2), `most` of them at most, and points (n, 3) on a sphere (4,).

    Of all the pixels that see it where both sensors face it.
    """
    centre, radius = sphere[:3], sphere[3]
    middle = project(camera.intrinsics, camera.pose, centre)
    depth = float(transform(camera.pose, centre)[2])
    reach = int(np.ceil(1.1 * camera.intrinsics.fx * radius / depth)) + 1
    x, y = np.meshgrid(*(np.arange(np.rint(m) - reach, np.rint(m) + reach + 1) for m in middle))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    inside = np.all((pixels >= 0) & (pixels <= [camera.columns - 1, camera.rows - 1]), axis=1)
    pixels = pixels[inside]
    origin, rays = camera.pose.centre(), ray_directions(camera.intrinsics, camera.pose, pixels)
    towards = rays @ (centre - origin)
    half = towards**2 - np.sum((centre - origin) ** 2) + radius**2
    hit = half > 0.0
    pixels, rays = pixels[hit], rays[hit]
    points = origin + (towards[hit] - np.sqrt(half[hit]))[:, None] * rays
    normal = (points - centre) / radius
    lit = projector.pose.centre() - points
    lit /= np.linalg.norm(lit, axis=1, keepdims=True)
    facing = (-np.sum(normal * rays, axis=1) > _LEAST_FACING) & (np.sum(normal * lit, axis=1) > _LEAST_FACING)
    chosen = np.flatnonzero(facing)
    if len(chosen) > most:
        chosen = np.sort(random.choice(chosen, most, replace=False))
    return pixels[chosen], points[chosen]


def bar_session(design: SessionDesign, seed: int) -> BarSession:
    """Return a session with the rig of `top_hat_bending`, noise and start drawn from a seed."""
    random = np.random.default_rng(seed)
    rig = top_hat_bending("session", "full")[0].rig
    sensors = tuple(_of_size(s, design.camera_pixels) for s in rig.sensors)
    true_length = design.length_mm + design.length_sigma_mm * random.standard_normal()
    radii = design.radius_mm + design.radius_sigma_mm * random.standard_normal(2)
    centres = np.array([sphere_centres(*angles, true_length) for angles in design.angles]).reshape(-1, 2, 3)
    spheres = np.concatenate([centres, np.broadcast_to(radii[:, None], (len(centres), 2, 1))], axis=2)
    cameras = [i for i, s in enumerate(sensors) if s.role is Role.CAMERA]
    projectors = [i for i, s in enumerate(sensors) if s.role is Role.PROJECTOR]
    bar_points = [
        _bar_points(sensors, (pose, c, p), spheres[pose], design, random)
        for pose in range(len(centres))
        for c in cameras
        for p in projectors
    ]
    poses, board_points = _boards(sensors, design, random)
    bar = BundleBar("bar", design.length_mm, design.length_sigma_mm, design.radius_mm, design.radius_sigma_mm)
    board = BundleBoard("board", design.pitch_relative_sigma, design.point_sigma_mm)
    begun = 2.0 * design.start * random.standard_normal(centres.shape)
    problem = BundleProblem(
        sensors=tuple(_started(s, design.start, random) for s in sensors),
        boards=(board,) if poses else (),
        bars=(bar,) if len(centres) else (),
        board_poses=poses,
        bar_poses=tuple(BarPose(f"A{k + 1:02d}", 0, c) for k, c in enumerate(centres + begun)),
        board_points=board_points,
        bar_points=tuple(bar_points),
        world_board=0 if poses else None,
        volume=(np.array([-270.0, -270.0, -250.0]), np.array([270.0, 270.0, 250.0])),
    )
    return BarSession(problem, sensors, centres)


def _of_size(sensor: Sensor, pixels: int) -> Sensor:
    """Return a camera with another number of pixels; projectors as they are."""
    if sensor.role is Role.PROJECTOR:
        return sensor
    inner, by = sensor.intrinsics, pixels / sensor.columns
    lens = replace(
        inner,
        fx=inner.fx * by,
        fy=inner.fy * by,
        cx=(inner.cx + 0.5) * by - 0.5,
        cy=(inner.cy + 0.5) * by - 0.5,
    )
    return replace(sensor, columns=pixels, rows=pixels, intrinsics=lens)


def _bar_points(
    sensors: tuple[Sensor, ...],
    at: tuple[int, int, int],
    spheres: Floats,
    design: SessionDesign,
    random: np.random.Generator,
) -> BarPoints:
    pose, c, p = at
    pixels, projected, labels = [], [], []
    for k in (0, 1):
        own, points = seen_on_sphere(sensors[c], sensors[p], spheres[k], design.points, random)
        exact = project(sensors[p].intrinsics, sensors[p].pose, points)
        pixels.append(own)
        projected.append(exact + design.phase_sigma_px * random.standard_normal(exact.shape))
        labels.append(np.full(len(own), k + 1, np.int32))
    sphere = np.concatenate(labels)
    sigma = np.full(len(sphere), design.phase_sigma_px)
    return BarPoints(pose, c, p, sphere, np.concatenate(pixels), np.concatenate(projected), sigma)


def _boards(
    sensors: tuple[Sensor, ...], design: SessionDesign, random: np.random.Generator
) -> tuple[tuple[BoardPose, ...], tuple[BoardPoints, ...]]:
    """Return board poses and what each sensor saw: 15 x 11 dots of 20 mm pitch, each printed a little off."""
    columns, rows = np.meshgrid(np.arange(15), np.arange(11))
    stated = 20.0 * np.stack([columns.ravel() - 7.0, rows.ravel() - 5.0, np.zeros(columns.size)], axis=1)
    scale = 1.0 + design.pitch_relative_sigma * random.standard_normal()
    poses, points = [], []
    for number, vector in enumerate(design.board_tilts):
        off = random.uniform(-60.0, 60.0, 3) if number else np.zeros(3)
        pose = Pose.from_arrays(Rotation.from_rotvec(vector).as_matrix(), off)
        for i, sensor in enumerate(sensors):
            # The printing errors are drawn for each view: the adjustment takes them as independent.
            printed = scale * stated + design.point_sigma_mm * random.standard_normal(stated.shape)
            pixel = project(sensor.intrinsics, sensor.pose, transform(pose, printed))
            pixel += design.dot_sigma_px * random.standard_normal(pixel.shape)
            sigma = np.full(len(stated), design.dot_sigma_px)
            points.append(BoardPoints(number, i, sensor.role is Role.PROJECTOR, stated, pixel, sigma))
        begun = pose if number == 0 else _moved(pose, design.start, random)
        poses.append(BoardPose(f"B{number + 1:02d}", 0, begun))
    return tuple(poses), tuple(points)


def _moved(pose: Pose, by: float, random: np.random.Generator) -> Pose:
    """Return a pose that is off by about 1e-3 rad and 2 mm."""
    turn = Rotation.from_rotvec(1e-3 * by * random.standard_normal(3)).as_matrix()
    return Pose.from_arrays(turn @ pose.matrix(), pose.translation + 2.0 * by * random.standard_normal(3))


def _started(sensor: Sensor, by: float, random: np.random.Generator) -> BundleSensor:
    """Return a sensor as an initialisation would leave it."""
    inner = sensor.intrinsics
    draw = by * random.standard_normal(5)
    off = np.zeros(PER_LENS)
    off[:PIN_HOLE] = 0.003 * draw[0] * inner.fx, 0.003 * draw[0] * inner.fy, 3.0 * draw[1], 3.0 * draw[2]
    off[PIN_HOLE : PIN_HOLE + 2] = 0.02 * draw[3:]
    begun = Intrinsics.from_vector(inner.vector() + off)
    return BundleSensor(sensor.name, begun, _moved(sensor.pose, by, random), (sensor.columns, sensor.rows))
