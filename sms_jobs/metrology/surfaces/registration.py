"""The rigid motion that lays measured points on a reference surface (thesis section 2.5).

Iterative closest points: thesis Eq. (1.28) sums the squared distances between each point and its
corresponding point of the CAD model. Here the distance is that to the surface, along its direction (Chen and
Medioni 1992), and counts in units of its own standard deviation: a point may slide along the surface, which
is what makes it converge in some steps, and noisy points say less. Points beyond what the rest lets expect
lose their weight (Tukey's biweight), so that a dent or a burr does not pull the part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.rigid_alignment import rigid_modes
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import rotation_matrix, transform, unpack
from sms_jobs.metrology.surfaces.closest_points import Closest, closest_points
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface

_FEWEST = 12
_OPPOSITE = 0.5  # cosine: normals more than 60 degrees apart are not of one surface
_TUKEY = 4.685  # sigmas: 95 % of the efficiency of least squares on Gaussian noise
_MAD = 1.4826
_WEAK = 1e-4
"""Directions in which the squared distance grows less than this part of the steepest are held.

A facet of 1 degree changes the normals of a cylinder by 0.3 degrees rms, 3e-5 of the square: its tessellation
must not tell how far a cylinder has turned about its own axis.
"""
_EXACT_MM = 1e-6


@dataclass(frozen=True)
class MeasuredPoints:
    """Points to be laid on a surface.

    Attributes
    ----------
    xyz
        (points, 3) in mm.
    normals
        (points, 3), of length 1, out of the material.
    covariance
        (6, points) in mm^2, packed XX, XY, XZ, YY, YZ, ZZ.
    """

    xyz: Floats
    normals: Floats
    covariance: NDArray[np.floating]

    def some(self, count: int) -> MeasuredPoints:
        """Return about `count` of the points, evenly chosen; all if there are no more."""
        step = max(1, len(self.xyz) // count)
        return MeasuredPoints(self.xyz[::step], self.normals[::step], self.covariance[:, ::step])


@dataclass(frozen=True)
class Registration:
    """A rigid motion found by registration: x_surface = R x + T.

    Attributes
    ----------
    pose
        R and T.
    covariance
        (6, 6) of a small turn about the origin of the surface's frame (rad) and a shift (mm). From the spread
        of the distances; 0 along directions that are held.
    scale
        Robust spread of the distances in units of their standard deviations, at least 1: form errors count as
        noise.
    rms_mm
        Of the distances, weighted.
    points, used_fraction
        How many points took part, and which part of them has weight.
    held
        Number of directions in which the surface does not tell where the points are; they stay as they were.
    iterations
        Until it moved no more, or until the limit.
    converged
        Whether it moved no more.
    """

    pose: Pose
    covariance: Floats
    scale: float
    rms_mm: float
    points: int
    used_fraction: float
    held: int
    iterations: int
    converged: bool


@dataclass(frozen=True)
class _Step:
    """One linear step: the motion about `centre`, and what is known of it."""

    turn: Floats
    shift: Floats
    centre: Floats
    covariance: Floats
    scale: float
    rms: float
    used: float
    held: int


def distances_to(
    surface: TriangleSurface, points: MeasuredPoints, pose: Pose, within_mm: float, threads: int = 1
) -> tuple[Closest, Floats, Mask]:
    """Return what is closest to the moved points, their distances' sigma in mm, and which are to be trusted.

    Trusted are points that face the surface: not beside its rim, and with a normal within 60 degrees of it.
    """
    closest = closest_points(surface, transform(pose, points.xyz), within_mm=within_mm, threads=threads)
    rotation = pose.matrix()
    along = closest.direction @ rotation  # in the points' own frame
    variance = np.einsum("ni,nij,nj->n", along, unpack(points.covariance), along)
    facing = np.sum(points.normals * (surface.face_normals[closest.face] @ rotation), axis=1) > _OPPOSITE
    trusted = (closest.face >= 0) & ~closest.on_border & facing & np.isfinite(variance)
    return closest, np.sqrt(np.maximum(variance, _EXACT_MM**2)), trusted


def register(
    surface: TriangleSurface,
    points: MeasuredPoints,
    start: Pose,
    *,
    within_mm: float = np.inf,
    iterations: int = 50,
    threads: int = 1,
) -> Registration:
    """Lay points on a surface, from a start that is near.

    Parameters
    ----------
    surface
        The reference.
    points
        What was measured.
    start
        x_surface = R x + T, near enough for most points to find their own part of the surface.
    within_mm
        Points farther away than this take no part.
    iterations
        At most, at least 1.
    threads
        Number of threads; the result does not depend on it.

    Raises
    ------
    InvalidInput
        `iterations` is below 1.
    MeasurementFailed
        Fewer than 12 points face the surface.

    Notes
    -----
    Minimises thesis Eq. (1.28) with distances to the surface, each over its sigma, under Tukey's biweight.
    The covariance is that of an M-estimator (Huber 1981, section 7.6), for noise that is independent from one
    point to the next. Neighbours that share noise make it too small.
    """
    if iterations < 1:
        raise InvalidInput(f"a registration takes at least 1 iteration, not {iterations}")
    pose, done, converged = start, 0, False
    while done < iterations and not converged:
        step = _step(surface, points, pose, within_mm, threads)
        pose = _moved(pose, step)
        converged = _is_small(step, transform(pose, points.xyz))
        done += 1
    shear = np.eye(6)
    shear[3:, :3] = _cross(step.centre)
    return Registration(
        pose,
        shear @ step.covariance @ shear.T,
        step.scale,
        step.rms,
        len(points.xyz),
        step.used,
        step.held,
        done,
        converged,
    )


def _is_small(step: _Step, points: Floats) -> bool:
    """Say whether a step moves no point by more than a hundredth of what is not known of the pose."""
    reach = float(np.linalg.norm(points - step.centre, axis=1).max())
    motion = float(np.linalg.norm(step.shift) + reach * np.linalg.norm(step.turn))
    variance = np.diag(step.covariance)
    spread = float(np.sqrt(variance[3:].sum() + reach**2 * variance[:3].sum()))
    return motion < max(0.01 * spread, _EXACT_MM)


def _cross(v: Floats) -> Floats:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _moved(pose: Pose, step: _Step) -> Pose:
    turn = rotation_matrix(step.turn)
    translation = turn @ (np.array(pose.translation) - step.centre) + step.centre + step.shift
    return Pose.from_arrays(turn @ pose.matrix(), translation)


def _step(
    surface: TriangleSurface, points: MeasuredPoints, pose: Pose, within_mm: float, threads: int
) -> _Step:
    closest, sigma, trusted = distances_to(surface, points, pose, within_mm, threads)
    count = int(np.count_nonzero(trusted))
    if count < _FEWEST:
        raise MeasurementFailed(
            f"{count} of {len(points.xyz)} points face the reference surface and a registration needs "
            f"{_FEWEST}: give a start nearer to it, or turn the surface over if its triangles face inwards"
        )
    distance, sigma = closest.distance[trusted], sigma[trusted]
    moved, direction = transform(pose, points.xyz[trusted]), closest.direction[trusted]
    centre = moved.mean(axis=0)
    gradient = np.einsum("ni,nij->nj", direction, rigid_modes(moved - centre)) / sigma[:, None]
    residual = distance / sigma
    scale = max(1.0, _MAD * float(np.median(np.abs(residual))))
    u = np.clip(residual / (_TUKEY * scale), -1.0, 1.0)
    weight = (1.0 - u**2) ** 2
    # Rotations in units of the part's size, so that all six can be compared.
    size = np.r_[np.full(3, 1.0 / np.sqrt(np.mean(np.sum((moved - centre) ** 2, axis=1)))), np.ones(3)]
    scaled = gradient * size
    normal = scaled.T @ (weight[:, None] * scaled)
    strength, axes = np.linalg.eigh(normal)
    determined = strength > _WEAK * strength[-1]
    inverse = (axes[:, determined] / strength[determined]) @ axes[:, determined].T
    motion = -size * (inverse @ (scaled.T @ (weight * residual)))
    # Of an M-estimator: mean square of psi over the square of its mean slope.
    slope = float(np.mean((1.0 - u**2) * (1.0 - 5.0 * u**2)))
    spread = float(np.mean((weight * residual) ** 2)) / max(slope, 0.1) ** 2
    full, turned = np.linalg.eigh(scaled.T @ scaled)
    firm = full > _WEAK * full[-1]
    covariance = spread * (turned[:, firm] / full[firm]) @ turned[:, firm].T
    rms = float(np.sqrt(np.sum(weight * distance**2) / weight.sum()))
    return _Step(
        motion[:3],
        motion[3:],
        centre,
        size[:, None] * covariance * size,
        scale,
        rms,
        float(np.count_nonzero(weight > 0.0)) / len(points.xyz),
        int(6 - np.count_nonzero(determined)),
    )
