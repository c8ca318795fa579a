"""Points from camera rays and phase gradients: closest approach of two rays, or a ray and a plane of phase.

Two orientations of fringes make a ray of the projector of every camera pixel, one orientation a plane of
constant phase (thesis sections 2.3.3 and 2.4.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import pi
from typing import TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel
from sms_jobs.metrology.geometry.camera import Pose, pixel_grid, project, projection_jacobian, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.lens_kernels import undistorted
from sms_jobs.metrology.geometry.projector_pixels import to_pixel
from sms_jobs.metrology.geometry.transforms import PACKED
from sms_jobs.metrology.phase.patterns import direction, span_px

Vector: TypeAlias = tuple[float, float, float]

_NEWTON_STEPS = 12


@dataclass(frozen=True)
class Projector:
    """A projector: its camera model, and the size of its image in pixels."""

    intrinsics: Intrinsics
    pose: Pose
    columns: int
    rows: int


@dataclass(frozen=True)
class Triangulation:
    """Points of every camera pixel; NaN where omega is, or where the rays meet behind a sensor.

    Attributes
    ----------
    xyz
        (3, rows, columns) in mm, in the world's frame.
    covariance
        (6, rows, columns) in mm^2, packed XX, XY, XZ, YY, YZ, ZZ; from the noise of omega alone.
    ray_gap, ray_gap_sigma
        (rows, columns) in mm: signed distance epsilon_1 of the rays at closest approach, positive along
        camera ray x projector ray, and its standard deviation from the noise of omega. For one
        orientation a plane is met exactly: both are 0.
    part
        (rows, columns), 0 .. 1: how much of the covariance comes of the part of the variances that was told.
    """

    xyz: Floats
    covariance: Singles
    ray_gap: Singles
    ray_gap_sigma: Singles
    part: Singles


@lru_cache(maxsize=4)
def camera_rays(intrinsics: Intrinsics, pose: Pose, rows: int, columns: int, threads: int = 1) -> Floats:
    """Return the unit direction, in the world, of the ray of every pixel, (rows, columns, 3), read-only.

    Depends on the calibration alone, and is kept for the next call. NaN outside the lens's valid field. Made
    in blocks of rows, which fit into the processor's cache: five times as fast as the image at once.
    """
    rays = np.empty((rows, columns, 3))

    def work(start: int, stop: int) -> None:
        pixels = pixel_grid(stop - start, columns)
        pixels[..., 1] += start
        rays[start:stop] = ray_directions(intrinsics, pose, pixels)

    in_row_blocks(work, rows, threads, block=16)
    rays.setflags(write=False)
    return rays


def packed(
    camera_centre: Floats, projector: Projector, orientations: Sequence[float]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return a pair as kernels take it: centres, lens, to_pixel and turn.

    `centres` (3, 3) holds the two pin-holes and the centre of the projector's image (x, y, 0); `lens` is
    the vector of its intrinsics; `to_pixel` (2, orientations) is in px/rad; `turn` is the projector's
    rotation. Raises `InvalidInput` for parallel orientations.
    """
    image_centre = [0.5 * (projector.columns - 1), 0.5 * (projector.rows - 1), 0.0]
    centres = np.array([camera_centre, projector.pose.centre(), image_centre])
    matrix = np.ascontiguousarray(to_pixel(orientations, projector.columns, projector.rows))
    return centres, projector.intrinsics.vector(), matrix, projector.pose.matrix()


@inner
@kernel
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
@kernel
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
@kernel
def closest(u: Vector, v: Vector, base: Vector, towards: float) -> tuple[Vector, float]:
    """Find the point between two rays, relative to the first ray's origin, and the signed gap.

    The rays are s u and base + t v with s, t > 0 (else NaN). With n = u x v they are nearest at
    s = (base x v) n / n^2 and t = (base x u) n / n^2, and the way from one to the other there is
    n (base n) / n^2.
    """
    n = _cross(u, v)
    square = _dot(n, n)
    along = _dot(_cross(base, v), n) / square
    if not (along > 0.0 and _dot(_cross(base, u), n) > 0.0):
        return (np.nan, np.nan, np.nan), np.nan
    share = towards * _dot(base, n) / square
    point = (along * u[0] + share * n[0], along * u[1] + share * n[1], along * u[2] + share * n[2])
    return point, _dot(base, n) / np.sqrt(square)


@inner
@kernel
def closest_change(u: Vector, v: Vector, base: Vector, towards: float, dv: Vector) -> tuple[Vector, float]:
    """Return the derivatives of what `closest` returns when v changes by dv."""
    n, dn = _cross(u, v), _cross(u, dv)
    square, n_dn = _dot(n, n), _dot(n, dn)
    base_v, base_n, base_dn = _cross(base, v), _dot(base, n), _dot(base, dn)
    along = _dot(base_v, n) / square
    d_along = (_dot(_cross(base, dv), n) + _dot(base_v, dn) - 2.0 * along * n_dn) / square
    g = towards * base_n / square
    dg = (towards * base_dn - 2.0 * g * n_dn) / square
    change = (
        d_along * u[0] + dg * n[0] + g * dn[0],
        d_along * u[1] + dg * n[1] + g * dn[1],
        d_along * u[2] + dg * n[2] + g * dn[2],
    )
    return change, base_dn / np.sqrt(square) - base_n * n_dn / (square * np.sqrt(square))


@inner
@kernel
def turned(turn: Floats, x: float, y: float, z: float) -> Vector:
    """Bring a direction of the projector's frame into the world: the transposed rotation times it."""
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
        turn[0, 2] * x + turn[1, 2] * y + turn[2, 2] * z,
    )


@kernel
def _triangulate_rows(
    rays: Floats,
    omega: Floats,
    omega_sigma: Singles,
    part: Singles,
    centres: Floats,
    turn: Floats,
    lens: Floats,
    to_pixel: Floats,
    towards: float,
    block: tuple[int, int],
    xyz: Floats,
    covariance: Singles,
    gap: Singles,
    told: Singles,
) -> None:
    """Fill a block of rows of xyz (3, r, c), covariance (6, r, c), gap (2, r, c) and told (r, c).

    `centres`, `turn`, `lens` and `to_pixel` are those of `packed`.
    """
    base = (centres[1, 0] - centres[0, 0], centres[1, 1] - centres[0, 1], centres[1, 2] - centres[0, 2])
    pixel, inner, change = np.empty(2), np.empty(6), np.empty(3)
    for row in range(block[0], block[1]):
        for column in range(omega.shape[2]):
            for i in range(6):
                covariance[i, row, column] = np.nan
                xyz[i % 3, row, column] = gap[i % 2, row, column] = np.nan
            told[row, column] = np.nan
            for i in range(2):
                pixel[i] = centres[2, i]
                for k in range(omega.shape[0]):
                    pixel[i] += to_pixel[i, k] * omega[k, row, column]
            if not undistorted(lens, pixel, inner):
                continue
            u = (rays[row, column, 0], rays[row, column, 1], rays[row, column, 2])
            v = turned(turn, inner[0], inner[1], 1.0)
            point, distance = closest(u, v, base, towards)
            if not np.isfinite(distance):
                continue
            gap[0, row, column] = distance
            gap_variance, every, some = 0.0, 0.0, 0.0
            for i in range(3):
                xyz[i, row, column] = centres[0, i] + point[i]
                covariance[i, row, column] = covariance[i + 3, row, column] = 0.0
            for k in range(omega.shape[0]):
                px, py = to_pixel[0, k], to_pixel[1, k]
                dv = turned(turn, inner[2] * px + inner[3] * py, inner[4] * px + inner[5] * py, 0.0)
                moved, opened = closest_change(u, v, base, towards, dv)
                variance = np.float64(omega_sigma[k, row, column]) ** 2
                gap_variance += opened * opened * variance
                moves = _dot(moved, moved) * variance
                every += moves
                some += moves * part[k, row, column]
                change[0], change[1], change[2] = moved
                at = 0
                for i in range(3):
                    for j in range(i, 3):
                        covariance[at, row, column] += change[i] * change[j] * variance
                        at += 1
            gap[1, row, column] = np.sqrt(gap_variance)
            told[row, column] = some / every if every > 0.0 else 0.0


def triangulate(
    camera_centre: Floats,
    rays: Floats,
    projector: Projector,
    orientations: Sequence[float],
    omega: Floats,
    omega_sigma: Singles,
    *,
    part: Singles | None = None,
    towards_projector: float = 0.0,
    threads: int = 1,
) -> Triangulation:
    """Find the point of every camera pixel by closest approach of its ray to the projector's ray.

    Parameters
    ----------
    camera_centre
        Pin-hole of the camera in the world, (3,) in mm.
    rays
        (rows, columns, 3) unit directions in the world, from `camera_rays`.
    projector
        Whose distortion is removed from the ray.
    orientations
        Directions of the fringes in rad; one alone is met as a surface of constant phase.
    omega, omega_sigma
        (orientations, rows, columns) in rad per fringe: the phase gradients and their standard deviations,
        taken as independent.
    part
        Likewise, 0 .. 1: a part of each variance whose share in the covariance is wanted; None for none.
    towards_projector
        Where the point lies between the nearest points of the two rays: 0 on the camera's, 0.5 half way,
        1 on the projector's.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    Thesis Fig. 12 and Eq. (1.26): the gap is epsilon_1. The point is taken on the camera's ray because
    that one is free of noise, being named by its pixel, and the projector's is measured: half way, half of
    the gap's noise would go into the position across the ray and from there into strain. The covariance
    is J diag(sigma^2) J^T with the analytic Jacobian J = d(point)/d(omega).

    Raises `InvalidInput` for parallel orientations.
    """
    if part is None:
        part = np.zeros(omega.shape, np.float32)
    if len(orientations) == 1:
        return _meet_phase_surface(
            camera_centre, rays, projector, orientations[0], omega[0], omega_sigma[0], part[0], threads
        )
    rows, columns = omega.shape[1:]
    xyz = np.empty((3, rows, columns))
    covariance = np.empty((6, rows, columns), np.float32)
    gap = np.empty((2, rows, columns), np.float32)
    told = np.empty((rows, columns), np.float32)
    centres, lens, to_pixel, turn = packed(camera_centre, projector, orientations)

    def work(start: int, stop: int) -> None:
        _triangulate_rows(
            rays,
            omega,
            omega_sigma,
            part,
            centres,
            turn,
            lens,
            to_pixel,
            towards_projector,
            (start, stop),
            xyz,
            covariance,
            gap,
            told,
        )

    in_row_blocks(work, rows, threads, block=16)
    return Triangulation(xyz, covariance, gap[0], gap[1], told)


def _meet_phase_surface(
    camera_centre: Floats,
    rays: Floats,
    projector: Projector,
    orientation: float,
    omega: Floats,
    omega_sigma: Singles,
    part: Singles,
    threads: int,
) -> Triangulation:
    """Meet each camera ray with the projector's surface of constant phase of one orientation.

    Without distortion that surface is a plane through the projector's pin-hole (thesis section 2.3.3),
    which starts a Newton iteration along the ray.
    """
    inner, pose = projector.intrinsics, projector.pose
    across = np.array(direction(orientation))
    period = span_px(projector.columns, projector.rows, orientation)
    middle = 0.5 * (np.array([projector.columns, projector.rows]) - 1.0)
    targets = omega * period / (2.0 * pi) + middle @ across
    xyz = np.empty((3, *omega.shape))
    covariance = np.empty((6, *omega.shape), np.float32)

    def work(start: int, stop: int) -> None:
        u, target = rays[start:stop], targets[start:stop]
        lens = np.array([across[0] * inner.fx, across[1] * inner.fy])
        offset = across @ [inner.cx, inner.cy] - target
        normal = np.stack([np.full_like(offset, lens[0]), np.full_like(offset, lens[1]), offset], -1)
        normal = normal @ pose.matrix()
        with np.errstate(invalid="ignore", divide="ignore"):
            along = normal @ (pose.centre() - camera_centre) / np.sum(normal * u, axis=-1)
            slope = np.ones_like(along)
            for _ in range(_NEWTON_STEPS):
                points = camera_centre + along[..., None] * u
                slope = np.einsum("i,...ij,...j", across, projection_jacobian(inner, pose, points), u)
                step = (project(inner, pose, points) @ across - target) / slope
                along = along - step
                if np.nanmax(np.abs(step), initial=0.0) < 1e-9:
                    break
            along[~((along > 0.0) & (np.abs(step) < 1e-6))] = np.nan
            sigma = omega_sigma[start:stop] * period / (2.0 * pi) / slope
        xyz[:, start:stop] = np.moveaxis(camera_centre + along[..., None] * u, -1, 0)
        for at, (i, j) in enumerate(PACKED):
            covariance[at, start:stop] = u[..., i] * u[..., j] * sigma**2
        covariance[:, start:stop][:, np.isnan(along)] = np.nan

    in_row_blocks(work, len(omega), threads)
    gap = np.where(np.isnan(xyz[0]), np.nan, 0.0).astype(np.float32)
    return Triangulation(xyz, covariance, gap, gap.copy(), part)
