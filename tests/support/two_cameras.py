"""Images of a curved, textured surface by cameras, and exactly which point each pixel sees.

A surface z(x, y) about the world's origin carries a smooth random texture that is a function of the material
point, and may be displaced. The point that a pixel sees is found by Newton's method on its ray, so that all
images, of all cameras and states, show one texture; nothing of it is shared with what is tested.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.geometry.camera import Camera, Pose, pixel_grid, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics

Floats: TypeAlias = NDArray[np.float64]
Height: TypeAlias = Callable[[Floats, Floats], Floats]
Motion: TypeAlias = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]

PITCH_MM, TEXTURE_SIDE = 0.25, 800
VOLUME = ((-200.0, -200.0, -80.0), (200.0, 200.0, 80.0))


def flat(x: Floats, y: Floats) -> Floats:
    return 0.0 * x


def curved(x: Floats, y: Floats) -> Floats:
    """A cylinder of 300 mm about an axis along y, with waves of 2 mm along it."""
    return -(x**2) / 600.0 + 2.0 * np.cos(y / 15.0)


def at_rest(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    return 0.0 * x, 0.0 * x, 0.0 * x


def cameras(
    columns: int = 400,
    rows: int = 300,
    *,
    count: int = 2,
    angle_deg: float = 20.0,
    distance_mm: float = 600.0,
) -> tuple[Camera, ...]:
    """Return cameras on an arc about the origin, which they look at through lenses that distort."""
    found = []
    for number in range(count):
        angle = np.deg2rad(angle_deg) * (number - 0.5 * (count - 1))
        centre = distance_mm * np.array([np.sin(angle), 0.05 * number, np.cos(angle)])
        pose = Pose.looking_at(centre, np.zeros(3), np.array([0.0, 1.0, 0.0]))
        lens = Intrinsics(2400.0, 2390.0, 0.5 * columns, 0.5 * rows - 1.0, k1=-0.1, p1=1e-3)
        found.append(Camera(lens, pose, columns, rows))
    return tuple(found)


def _texture(speckle_mm: float, seed: int) -> Floats:
    noise = np.random.default_rng(seed).normal(size=(TEXTURE_SIDE, TEXTURE_SIDE))
    smooth = ndimage.gaussian_filter(noise, 0.5 * speckle_mm / PITCH_MM, mode="wrap")
    levels = 2000.0 + 800.0 * np.tanh(1.2 * smooth / smooth.std())
    return np.asarray(ndimage.spline_filter(levels, 5, mode="grid-wrap"))


@dataclass(frozen=True)
class Seen:
    """What a camera sees: grey levels (rows, columns), points (3, rows, columns) in mm, material x and y."""

    levels: Floats
    points: Floats
    material: Floats


def seen_by(
    camera: Camera, height: Height, motion: Motion = at_rest, *, speckle_mm: float = 0.6, seed: int = 1
) -> Seen:
    """Return what a camera sees, without noise."""
    rays = ray_directions(camera.intrinsics, camera.pose, pixel_grid(camera.rows, camera.columns))
    centre = camera.pose.centre()
    met = centre - (centre[2] / rays[..., 2])[..., None] * rays
    x, y = met[..., 0], met[..., 1]

    def place(x: Floats, y: Floats) -> Floats:
        return np.stack([x, y, height(x, y)], axis=-1) + np.stack(motion(x, y), axis=-1)

    right = np.cross(rays, [0.0, 1.0, 0.0])
    down = np.cross(right, rays)
    h = 1e-3
    for _ in range(12):
        off = place(x, y) - centre
        a, b = (np.sum(off * across, axis=-1) for across in (right, down))
        slopes = [
            (place(x + h * i, y + h * j) - place(x - h * i, y - h * j)) / (2.0 * h)
            for i, j in ((1, 0), (0, 1))
        ]
        (ax, ay), (bx, by) = (
            [np.sum(slope * across, axis=-1) for slope in slopes] for across in (right, down)
        )
        determinant = ax * by - ay * bx
        x, y = x - (by * a - ay * b) / determinant, y - (ax * b - bx * a) / determinant
    at = np.stack([y, x]) / PITCH_MM + 0.5 * TEXTURE_SIDE
    levels = ndimage.map_coordinates(
        _texture(speckle_mm, seed), at, order=5, mode="grid-wrap", prefilter=False
    )
    return Seen(np.asarray(levels), np.moveaxis(place(x, y), -1, 0), np.stack([x, y]))
