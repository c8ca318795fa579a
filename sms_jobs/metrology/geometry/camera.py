"""The camera model, for cameras and projectors alike: a pin-hole with the distortion of OpenCV.

A point X of the world, in millimetres, is first brought into the sensor's frame, x = R X + T (thesis
Eq. (1.23), with its pin-hole at -R^T T), then projected and distorted, then scaled to pixels. Pixel
(0, 0) is the centre of the top-left pixel; x points right, y down, z forward; the frame is right-handed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

_NEWTON_STEPS = 20
_NEWTON_TOLERANCE = 1e-14  # in units of the focal length: five orders below a nanometre at a metre


@dataclass(frozen=True)
class Intrinsics:
    """The inner parameters of a sensor.

    Attributes
    ----------
    fx, fy
        Focal lengths, in pixels.
    cx, cy
        Principal point, in pixels.
    k1, k2, p1, p2, k3
        Radial (k) and tangential (p) distortion, in OpenCV's order and meaning; dimensionless.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    def matrix(self) -> Floats:
        """Return the 3 x 3 matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def distortion(self) -> Floats:
        """Return (k1, k2, p1, p2, k3)."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])


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


def distort(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Distort normalised image points.

    Parameters
    ----------
    intrinsics
        Of the sensor.
    points
        (..., 2), x/z and y/z, dimensionless.

    Returns
    -------
    (..., 2), distorted.

    Notes
    -----
    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2) and
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y
    (Brown 1966, as in OpenCV; the thesis's Eq. (1.22) is its radial part).
    """
    x, y = points[..., 0], points[..., 1]
    k1, k2, p1, p2, k3 = intrinsics.distortion()
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def distortion_jacobian(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Return d(distorted)/d(normalised), (..., 2, 2), at normalised points (..., 2)."""
    x, y = points[..., 0], points[..., 1]
    k1, k2, p1, p2, k3 = intrinsics.distortion()
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    return np.stack(
        [
            np.stack([radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, cross], axis=-1),
            np.stack([cross, radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x], axis=-1),
        ],
        axis=-2,
    )


def undistort(intrinsics: Intrinsics, points: Floats) -> Floats:
    """Invert `distort` by Newton's method.

    Parameters
    ----------
    intrinsics
        Of the sensor.
    points
        (..., 2), distorted.

    Returns
    -------
    (..., 2), normalised; NaN where the iteration does not converge (outside the lens's valid field).
    """
    wanted = np.asarray(points, dtype=np.float64)
    found = wanted.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            residual = distort(intrinsics, found) - wanted
            if np.nanmax(np.abs(residual), initial=0.0) < _NEWTON_TOLERANCE:
                break
            j = distortion_jacobian(intrinsics, found)
            determinant = j[..., 0, 0] * j[..., 1, 1] - j[..., 0, 1] * j[..., 1, 0]
            dx = (j[..., 1, 1] * residual[..., 0] - j[..., 0, 1] * residual[..., 1]) / determinant
            dy = (j[..., 0, 0] * residual[..., 1] - j[..., 1, 0] * residual[..., 0]) / determinant
            found -= np.stack([dx, dy], axis=-1)
        bad = np.max(np.abs(distort(intrinsics, found) - wanted), axis=-1) > 1e-9
    found[bad] = np.nan
    return found


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


def ray_direction_jacobian(intrinsics: Intrinsics, pose: Pose, pixels: Floats) -> Floats:
    """Return d(unit ray direction)/d(pixel), (..., 3, 2) in 1/px, at pixels (..., 2)."""
    distorted = (np.asarray(pixels, dtype=np.float64) - [intrinsics.cx, intrinsics.cy]) / [
        intrinsics.fx,
        intrinsics.fy,
    ]
    normalised = undistort(intrinsics, distorted)
    to_normalised = np.linalg.inv(distortion_jacobian(intrinsics, normalised)) / [
        intrinsics.fx,
        intrinsics.fy,
    ]
    inside = np.concatenate([normalised, np.ones_like(normalised[..., :1])], axis=-1)
    length = np.linalg.norm(inside, axis=-1, keepdims=True)
    unit = inside / length
    lifted = np.zeros((*normalised.shape[:-1], 3, 2))
    lifted[..., :2, :] = to_normalised
    across = lifted - unit[..., :, None] * np.sum(unit[..., :, None] * lifted, axis=-2, keepdims=True)
    return np.asarray(pose.matrix().T @ (across / length[..., None]))


def pixel_grid(rows: int, columns: int) -> Floats:
    """Return the coordinates (x, y) of every pixel centre, (rows, columns, 2), in pixels."""
    y, x = np.mgrid[0:rows, 0:columns]
    return np.stack([x, y], axis=-1).astype(np.float64)
