"""The camera model, for cameras and projectors alike: where a sensor stands, and a pin-hole with a lens.

A point X of the world, in millimetres, is first brought into the sensor's frame, x = R X + T (thesis
Eq. (1.23), with its pin-hole at -R^T T), then projected, distorted and scaled to pixels by its `lens`. Pixel
(0, 0) is the centre of the top-left pixel; x points right, y down, z forward; the frame is right-handed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.lens import LENS, Intrinsics, distort, distortion_jacobian, undistort

POSE_PARAMETERS = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Parameters of a pose: a small rotation from the left, R <- exp([r]x) R, and the translation."""

SENSOR_PARAMETERS = (*POSE_PARAMETERS, *LENS)
"""Parameters of a sensor in their order: those of its pose, then those of its lens."""

PER_POSE, PER_SENSOR = len(POSE_PARAMETERS), len(SENSOR_PARAMETERS)


@dataclass(frozen=True)
class Pose:
    """Where a sensor stands: x_sensor = rotation @ X_world + translation.

    Attributes
    ----------
    rotation
        Rows of the 3 x 3 rotation matrix.
    translation
        In mm; this is not the pin-hole, which lies at `centre()`.
    """

    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    translation: tuple[float, float, float]

    @classmethod
    def from_arrays(cls, rotation: Floats, translation: Floats) -> Pose:
        """Build a pose from a (3, 3) matrix and a (3,) vector in mm."""
        r = np.asarray(rotation, dtype=np.float64)
        a, b, c = ((float(row[0]), float(row[1]), float(row[2])) for row in r)
        return cls((a, b, c), (float(translation[0]), float(translation[1]), float(translation[2])))

    @classmethod
    def looking_at(cls, centre: Floats, target: Floats, up: Floats) -> Pose:
        """Build the pose of a sensor at `centre` that looks at `target`, `up` pointing up in its image.

        All three are (3,) in mm (`up` in any unit).
        """
        z = np.asarray(target, dtype=np.float64) - centre
        z /= np.linalg.norm(z)
        x = np.cross(z, up)
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        return cls.from_arrays(rotation, -rotation @ np.asarray(centre, dtype=np.float64))

    def matrix(self) -> Floats:
        """Return the rotation as a (3, 3) array."""
        return np.array(self.rotation)

    def centre(self) -> Floats:
        """Return the pin-hole in the world, (3,) in mm."""
        return np.asarray(-self.matrix().T @ np.array(self.translation))


@dataclass(frozen=True)
class Camera:
    """A camera: its model, and the size of its image in pixels."""

    intrinsics: Intrinsics
    pose: Pose
    columns: int
    rows: int


def project(intrinsics: Intrinsics, pose: Pose, points: Floats) -> Floats:
    """Project points of the world into the image.

    Parameters
    ----------
    intrinsics, pose
        Of the sensor.
    points
        (..., 3) in mm.

    Returns
    -------
    (..., 2) pixel coordinates (x, y); NaN for points at or behind the pin-hole's plane.

    Notes
    -----
    Thesis Eq. (1.7)-(1.12) and (1.21)-(1.23), in pixel units.
    """
    inside = points @ pose.matrix().T + np.array(pose.translation)
    depth = np.where(inside[..., 2:] > 0.0, inside[..., 2:], np.nan)
    distorted = distort(intrinsics, inside[..., :2] / depth)
    return distorted * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


def projection_jacobian(intrinsics: Intrinsics, pose: Pose, points: Floats) -> Floats:
    """Return d(pixel)/d(world point), (..., 2, 3) in px/mm, at world points (..., 3) in mm."""
    inside = points @ pose.matrix().T + np.array(pose.translation)
    z = inside[..., 2]
    normalised = inside[..., :2] / z[..., None]
    to_normalised = np.zeros((*z.shape, 2, 3))
    to_normalised[..., 0, 0] = to_normalised[..., 1, 1] = 1.0 / z
    to_normalised[..., :, 2] = -normalised / z[..., None]
    focal = np.array([[intrinsics.fx], [intrinsics.fy]])
    return focal * (distortion_jacobian(intrinsics, normalised) @ to_normalised @ pose.matrix())


def ray_directions(intrinsics: Intrinsics, pose: Pose, pixels: Floats) -> Floats:
    """Return the unit directions, in the world, of the rays through pixels.

    Parameters
    ----------
    intrinsics, pose
        Of the sensor.
    pixels
        (..., 2) pixel coordinates (x, y).

    Returns
    -------
    (..., 3), pointing away from the pin-hole `pose.centre()`; NaN outside the lens's valid field.
    """
    distorted = (np.asarray(pixels, dtype=np.float64) - [intrinsics.cx, intrinsics.cy]) / [
        intrinsics.fx,
        intrinsics.fy,
    ]
    normalised = undistort(intrinsics, distorted)
    inside = np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)
    inside /= np.linalg.norm(inside, axis=-1, keepdims=True)
    return np.asarray(inside @ pose.matrix())


def pixel_grid(rows: int, columns: int) -> Floats:
    """Return the coordinates (x, y) of every pixel centre, (rows, columns, 2), in pixels."""
    x, y = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)
    return np.stack(np.meshgrid(x, y), axis=-1)


def pixel_maps(rows: int, columns: int) -> Floats:
    """Return x and y of every pixel centre as maps, (2, rows, columns), in pixels."""
    maps = np.empty((2, rows, columns))
    maps[0], maps[1] = np.arange(columns), np.arange(rows)[:, None]
    return maps
