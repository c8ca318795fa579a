"""Where a ray of light meets a deformed specimen, and whether two points see each other.

A ray is followed back to the specimen at rest, where every patch is a plane or a quadric, and its meeting
with a patch found by Newton's method on the distance along it. The result is exact to rounding, about
1e-11 mm, for every deformation.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel
from sms_jobs.records.scene import Deformation, PanTilt, PlateAndMirror, Rigid, Scene
from sms_jobs.virtual_rig.deformations import (
    bending_slack,
    carried,
    carried_points,
    followed_back,
    packed_chain,
)
from sms_jobs.virtual_rig.surfaces import (
    near_patch,
    on_patch,
    packed,
    patch_coordinates,
    patch_normal,
    patches_of,
    step_to_patch,
)

TOUCHING_MM = 1e-6
"""Surfaces closer than this along a ray are one: far above rounding, far below anything measured."""


class Specimen(NamedTuple):
    """A specimen in one state, as kernels take it.

    `chain` carries it to the world; `middle` is where its origin then lies, in mm; `slack` bounds, in mm,
    what the deformation adds to an affine map.
    """

    patches: Floats
    cutouts: Floats
    chain: Floats
    middle: Floats
    slack: float


def specimen_in(scene: Scene, deformation: tuple[Deformation, ...]) -> Specimen:
    """Return the scene's specimen after a deformation.

    Raises
    ------
    InvalidInput
        When a plate and mirror are to do anything but move rigidly.
    """
    bent = [d.motion for d in deformation if not isinstance(d, Rigid | PanTilt)]
    if isinstance(scene.surface, PlateAndMirror) and bent:
        raise InvalidInput(f"a plate and mirror can only move rigidly, not by {bent[0]}; use a rigid motion")
    patches, cutouts = packed(patches_of(scene.surface))
    chain = packed_chain(deformation, scene.placement)
    middle = carried_points(chain, np.zeros((1, 3)))[0]
    return Specimen(patches, cutouts, chain, middle, bending_slack(deformation))


@inner
@uncounted_kernel
def first_hit(
    specimen: Specimen, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, beyond: float
) -> tuple[float, int, float, float, float]:
    """Return how far along a ray it first meets the specimen, on which patch, and the material point.

    The direction is a unit vector. Meetings nearer than `beyond` mm do not count. A ray that meets
    nothing has the patch -1 and an infinite distance.
    """
    patches, cutouts, chain, middle, slack = specimen
    start = (middle[0] - ox) * dx + (middle[1] - oy) * dy + (middle[2] - oz) * dz
    m0x, m0y, m0z, v0x, v0y, v0z, _ = followed_back(
        chain, ox + start * dx, oy + start * dy, oz + start * dz, dx, dy, dz
    )
    best, best_patch = np.inf, -1
    best_x = best_y = best_z = np.nan
    for i in range(patches.shape[0]):
        patch = patches[i]
        step, met = step_to_patch(patch, m0x, m0y, m0z, v0x, v0y, v0z)
        if not np.isfinite(step) or (slack == 0.0 and not met):
            continue
        mx, my, mz = m0x + step * v0x, m0y + step * v0y, m0z + step * v0z
        a, b = patch_coordinates(patch, mx, my, mz)
        # The first step is off by what bending adds, and by more for a ray that grazes the patch.
        nx, ny, nz = patch_normal(patch, mx, my, mz)
        facing = abs(nx * v0x + ny * v0y + nz * v0z)
        if not near_patch(patch, a, b, 1e-6 + 2.0 * slack / max(facing, 1e-6)):
            continue
        s, mx, my, mz, met = refined_hit(patch, chain, ox, oy, oz, dx, dy, dz, start + step)
        if not met or s <= beyond or s >= best:
            continue
        a, b = patch_coordinates(patch, mx, my, mz)
        if on_patch(patch, cutouts, a, b):
            best, best_patch, best_x, best_y, best_z = s, i, mx, my, mz
    return best, best_patch, best_x, best_y, best_z


@inner
@uncounted_kernel
def refined_hit(
    patch: Floats,
    chain: Floats,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    s: float,
) -> tuple[float, float, float, float, bool]:
    """Refine the distance `s` at which a ray meets a patch, and return it with the material point.

    The last value is False when they do not meet.
    """
    mx = my = mz = np.nan
    met = material = False
    for _ in range(30):
        mx, my, mz, vx, vy, vz, material = followed_back(
            chain, ox + s * dx, oy + s * dy, oz + s * dz, dx, dy, dz
        )
        step, met = step_to_patch(patch, mx, my, mz, vx, vy, vz)
        if not np.isfinite(step):
            return s, mx, my, mz, False
        s += step
        # Newton squares the error: after a step below 1e-6 mm the rest is rounding. The material point
        # is taken along the same step rather than followed back once more.
        if abs(step) < 1e-6:
            return s, mx + step * vx, my + step * vy, mz + step * vz, met and material
    return s, mx, my, mz, False


@inner
@uncounted_kernel
def unit_to(
    ox: float, oy: float, oz: float, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Return the unit direction from one point to another, and their distance."""
    dx, dy, dz = x - ox, y - oy, z - oz
    length = sqrt(dx * dx + dy * dy + dz * dz)
    return dx / length, dy / length, dz / length, length


@inner
@uncounted_kernel
def unobstructed(specimen: Specimen, ox: float, oy: float, oz: float, x: float, y: float, z: float) -> bool:
    """Tell whether a point on the specimen is in free sight of a point off it."""
    dx, dy, dz, length = unit_to(ox, oy, oz, x, y, z)
    s, _, _, _, _ = first_hit(specimen, ox, oy, oz, dx, dy, dz, 0.0)
    return s >= length - TOUCHING_MM


@inner
@uncounted_kernel
def surface_normal(
    specimen: Specimen, patch: int, mx: float, my: float, mz: float
) -> tuple[float, float, float]:
    """Return the outward unit normal, in the world, of the deformed surface at a material point."""
    nx, ny, nz = patch_normal(specimen.patches[patch], mx, my, mz)
    _, _, _, nx, ny, nz = carried(specimen.chain, mx, my, mz, nx, ny, nz)
    length = sqrt(nx * nx + ny * ny + nz * nz)
    return nx / length, ny / length, nz / length
