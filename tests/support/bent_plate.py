"""A plate pushed out at its middle: its exact surface, and what a camera of the virtual rig sees of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.surfaces.registration import MeasuredPoints
from sms_jobs.records.scene import MidPointBending, Plane, Scene, Simulation
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, PROJECTOR_LENS, aimed
from sms_jobs.virtual_rig.truth import exact_shape

WIDTH, HEIGHT, DEFLECTION = 420.0, 400.0, 60.0
PIXELS = 96
GRID_MM = 2.0
# The plate's curvature is at most 24 * 60 / 400^2 = 0.009 / mm, once along each axis: a square of 2 mm is off
# its chords by 0.009 * 2^2 / 8 each.
CHORD_ERROR_MM = 0.009
PLACEMENT = Pose.from_arrays(
    Rotation.from_rotvec([0.04, -0.03, 0.02]).as_matrix(), np.array([4.0, -3.0, 6.0])
)
CAMERA = aimed("C1", PIXELS, PIXELS, CAMERA_LENS, (-500.0, 60.0, 2400.0), 0.05)
PROJECTOR = aimed("P1", 128, 96, PROJECTOR_LENS, (700.0, -50.0, 2300.0))


def _line(s: np.ndarray) -> np.ndarray:
    """The deflection line of a beam clamped at both ends, see `MidPointBending`."""
    return 1.0 - 12.0 * s**2 + 16.0 * np.abs(s) ** 3


def plate_surface() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and faces (m, 3) of the bent plate in its own frame, outwards along z."""
    x = np.linspace(-WIDTH / 2, WIDTH / 2, int(WIDTH / GRID_MM) + 1)
    y = np.linspace(-HEIGHT / 2, HEIGHT / 2, int(HEIGHT / GRID_MM) + 1)
    across, down = np.meshgrid(x, y)
    z = DEFLECTION * _line(across / WIDTH) * _line(down / HEIGHT)
    n = np.arange(z.size).reshape(z.shape)
    a, b, c, d = n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return np.column_stack([across.ravel(), down.ravel(), z.ravel()]), faces


@dataclass(frozen=True)
class SeenPlate:
    """What a pixel sees: position and normal in the world (3, rows, columns), NaN where it sees nothing.

    The place on the plate, (3, rows, columns), is in its own frame before it was bent.
    """

    xyz: np.ndarray
    normal: np.ndarray
    place: np.ndarray

    def dented(self, depth: float, radius: float, at: tuple[float, float]) -> np.ndarray:
        """Return the positions with a dent of Gaussian shape: depth in mm at `at`, down along the normal."""
        square = (self.place[0] - at[0]) ** 2 + (self.place[1] - at[1]) ** 2
        return self.xyz - depth * np.exp(-0.5 * square / radius**2) * self.normal


@cache
def seen_plate() -> SeenPlate:
    """Return what the camera sees of the bent plate where it stands."""
    scene = Scene(Rig("rig", (CAMERA, PROJECTOR)), Plane(WIDTH, HEIGHT), placement=PLACEMENT)
    shape = exact_shape(Simulation(scene, "C1", "P1", (MidPointBending(DEFLECTION, WIDTH, HEIGHT),)))
    return SeenPlate(shape.xyz, shape.normal, shape.material)


def measured(plate: SeenPlate, xyz: np.ndarray, sigma: float, rng: np.random.Generator) -> MeasuredPoints:
    """Return points with noise of `sigma` along the view and a third of it across, and that covariance."""
    along = np.moveaxis(xyz, 0, -1) - CAMERA.pose.centre()
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    known = np.isfinite(xyz).all(axis=0)
    ray = along[known]
    across = sigma / 3.0
    full = across**2 * np.eye(3) + (sigma**2 - across**2) * ray[:, :, None] * ray[:, None, :]
    noise = across * rng.normal(size=ray.shape)
    noise += (np.sqrt(sigma**2 - across**2) * rng.normal(size=len(ray)))[:, None] * ray
    packed = np.stack([full[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])
    return MeasuredPoints(xyz[:, known].T + noise, plate.normal[:, known].T, packed)
