"""The specimens' surfaces, as patches of plane, cylinder and sphere with material coordinates (a, b).

A patch knows its material points in the specimen's frame at rest. Its coordinates (a, b) are lengths
along the material, in mm, in which the speckle is printed: on planes and cylinders they unroll the sheet,
on spheres they are Lambert's equal-area map from the pole.

Kernels take the patches as rows of an array, see `Packed`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import asin, atan2, cos, hypot, inf, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel
from sms_jobs.records.artefacts import BallBar, DotCylinder
from sms_jobs.records.scene import (
    Cylinder,
    Plane,
    PlateAndMirror,
    PlateWithHoleAndStep,
    Sphere,
    StiffenedPanel,
    Stud,
    Surface,
    TieRod,
    TopHat,
    Vector,
)
from sms_jobs.virtual_rig.artefacts import Board, axes_of, axis_of, bar_centres, edges_mm, outwards

PLANE, CYLINDER, SPHERE = 0, 1, 2
X_AXIS: Vector = (1.0, 0.0, 0.0)
Y_AXIS: Vector = (0.0, 1.0, 0.0)


@dataclass(frozen=True)
class Cutout:
    """Where a patch has no material: a disc (`half_b` 0) or a rectangle about (a, b), in mm."""

    a: float
    b: float
    half_a: float
    half_b: float = 0.0


@dataclass(frozen=True)
class Patch:
    """One smooth piece of surface.

    Attributes
    ----------
    region
        Its number, from 1.
    origin
        Where a = b = 0 on a plane; the point of the axis below it on a cylinder; a sphere's centre. In mm.
    along_a, along_b
        Unit vectors; the outward normal at a = b = 0 is their cross product.
    a_range, b_range
        Limits of the coordinates, in mm.
    kind, radius
        Plane, cylinder about `along_b`, or sphere, and its radius in mm.
    rim
        Largest distance of (a, b) from (0, 0), in mm.
    cutouts
        Places without material.
    reflectance
        0 for a diffuse patch; above 0 for a mirror.
    speckle_shift
        Added to (a, b) before the speckle is looked up: continues the print from patch to patch.
    """

    region: int
    origin: Vector
    along_a: Vector
    along_b: Vector
    a_range: tuple[float, float]
    b_range: tuple[float, float]
    kind: int = PLANE
    radius: float = inf
    rim: float = inf
    cutouts: tuple[Cutout, ...] = ()
    reflectance: float = 0.0
    speckle_shift: tuple[float, float] = (0.0, 0.0)


class Packed(NamedTuple):
    """Patches as kernels take them.

    Columns of `patches` (n, 25): kind 0, origin 1 - 3, along_a 4 - 6, along_b 7 - 9, normal 10 - 12,
    radius 13, limits 14 - 17, rim 18, reflectance 19, region 20, first and end cutout 21 - 22, speckle
    shift 23 - 24. Columns of `cutouts` (m, 4): a, b, half_a, half_b.
    """

    patches: Floats
    cutouts: Floats


def packed(patches: tuple[Patch, ...]) -> Packed:
    """Return patches as arrays."""
    rows: list[list[float]] = []
    cutouts: list[tuple[float, ...]] = []
    for p in patches:
        normal = np.cross(p.along_a, p.along_b)
        first = len(cutouts)
        cutouts += [(c.a, c.b, c.half_a, c.half_b) for c in p.cutouts]
        limits = [*p.a_range, *p.b_range, p.rim, p.reflectance, p.region, first, len(cutouts)]
        rows.append([p.kind, *p.origin, *p.along_a, *p.along_b, *normal, p.radius, *limits, *p.speckle_shift])
    return Packed(np.array(rows, dtype=np.float64), np.array(cutouts, dtype=np.float64).reshape(-1, 4))


def patches_of(surface: Surface) -> tuple[Patch, ...]:
    """Return the patches of a surface, regions numbered from 1 in order."""
    if isinstance(surface, Plane):
        return (_rectangle(1, (0.0, 0.0, 0.0), surface.width_mm, surface.height_mm),)
    if isinstance(surface, Cylinder):
        return (_cylinder(surface),)
    if isinstance(surface, Sphere):
        return (_sphere(surface),)
    if isinstance(surface, PlateWithHoleAndStep):
        return _plate_with_hole_and_step(surface)
    if isinstance(surface, TopHat):
        return _top_hat(surface)
    if isinstance(surface, StiffenedPanel):
        return _stiffened_panel(surface)
    if isinstance(surface, PlateAndMirror):
        return _plate_and_mirror(surface)
    if isinstance(surface, BallBar):
        return tuple(
            _ball(number, (float(x), float(y), float(z)), surface.radius_mm)
            for number, (x, y, z) in enumerate(bar_centres(surface), start=1)
        )
    if isinstance(surface, DotCylinder):
        return (_dot_cylinder(surface),)
    return (_board(surface),)


def _rectangle(
    region: int,
    origin: Vector,
    width: float,
    height: float,
    along_a: Vector = X_AXIS,
    along_b: Vector = Y_AXIS,
) -> Patch:
    a, b = width / 2.0, height / 2.0
    # A shift of its own for every rectangle keeps prints on different faces from looking alike.
    shift = (1000.0 * (region - 1), 0.0)
    return Patch(region, origin, along_a, along_b, (-a, a), (-b, b), speckle_shift=shift)


def _cylinder(surface: Cylinder) -> Patch:
    half = surface.radius_mm * asin(min(surface.width_mm / 2.0 / surface.radius_mm, 1.0))
    b = surface.height_mm / 2.0
    axis = (0.0, 0.0, -surface.radius_mm)
    return Patch(1, axis, X_AXIS, Y_AXIS, (-half, half), (-b, b), CYLINDER, surface.radius_mm)


def _sphere(surface: Sphere) -> Patch:
    everywhere = (-inf, inf)
    centre = (0.0, 0.0, -surface.radius_mm)
    rim = 2.0 * surface.radius_mm * sin(surface.cap_angle_rad / 2.0)
    return Patch(1, centre, X_AXIS, Y_AXIS, everywhere, everywhere, SPHERE, surface.radius_mm, rim)


def _ball(region: int, centre: Vector, radius: float) -> Patch:
    everywhere = (-inf, inf)
    return Patch(region, centre, X_AXIS, Y_AXIS, everywhere, everywhere, SPHERE, radius)


def _board(board: Board) -> Patch:
    """Return the plate of a board; (a, b) run to the right and up as it is seen from its front."""
    axes = axes_of(board)
    left, right, bottom, top = edges_mm(board)
    along_a, along_b = (axes.x_right, 0.0, 0.0), (0.0, -axes.y_down, 0.0)
    return Patch(1, (0.0, 0.0, 0.0), along_a, along_b, (left, right), (bottom, top))


def _dot_cylinder(cylinder: DotCylinder) -> Patch:
    """Return the whole outside; (a, b) run to the right from the middle of the columns, and up."""
    axes = axes_of(cylinder)
    _, _, bottom, top = edges_mm(cylinder)
    middle = (0.5 * (cylinder.columns - 1) - axes.column) * axes.x_right * cylinder.pitch_mm
    ((x, _, z),) = outwards(cylinder, np.array([middle])).tolist()
    up = -axes.y_down
    _, _, depth = axis_of(cylinder).tolist()
    half = pi * cylinder.diameter_mm / 2.0
    return Patch(
        *(1, (0.0, 0.0, depth), (up * z, 0.0, -up * x), (0.0, up, 0.0), (-half, half), (bottom, top)),
        kind=CYLINDER,
        radius=cylinder.diameter_mm / 2.0,
    )


def _plate_with_hole_and_step(surface: PlateWithHoleAndStep) -> tuple[Patch, ...]:
    """Return plate (1), top of the step (2) and its four walls (3 - 6: +x, -x, +y, -y)."""
    (x, y), (width, depth), height = surface.step_centre_mm, surface.step_size_mm, surface.step_height_mm
    hole = Cutout(*surface.hole_centre_mm, surface.hole_radius_mm)
    a, b = surface.width_mm / 2.0, surface.height_mm / 2.0
    cutouts = (hole, Cutout(x, y, width / 2.0, depth / 2.0))
    middle = height / 2.0
    return (
        Patch(1, (0.0, 0.0, 0.0), X_AXIS, Y_AXIS, (-a, a), (-b, b), cutouts=cutouts),
        _rectangle(2, (x, y, height), width, depth),
        _rectangle(3, (x + width / 2.0, y, middle), depth, height, Y_AXIS, (0.0, 0.0, 1.0)),
        _rectangle(4, (x - width / 2.0, y, middle), depth, height, (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
        _rectangle(5, (x, y + depth / 2.0, middle), width, height, (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        _rectangle(6, (x, y - depth / 2.0, middle), width, height, X_AXIS, (0.0, 0.0, 1.0)),
    )


def _top_hat(surface: TopHat) -> tuple[Patch, ...]:
    """Return base (1), side (2), top (3), side (4) and base (5), in order of x.

    The middle of the depth is at z = 0. The speckle shift is the length along the sheet.
    """
    top, side, low = surface.top_width_mm, surface.side_width_mm, -surface.depth_mm / 2.0
    base = (surface.width_mm - top) / 2.0 - side
    slope = hypot(side, surface.depth_mm)
    b = surface.height_mm / 2.0
    holes = tuple(Cutout(0.0, sign * surface.hole_offset_mm, surface.hole_radius_mm) for sign in (-1.0, 1.0))
    x_side, x_base = (top + side) / 2.0, top / 2.0 + side + base / 2.0
    s_side, s_base = (top + slope) / 2.0, top / 2.0 + slope + base / 2.0

    def strip(
        region: int,
        origin: Vector,
        length: float,
        along_a: Vector,
        shift: float,
        cut: tuple[Cutout, ...] = (),
    ) -> Patch:
        limits = (-length / 2.0, length / 2.0)
        return Patch(
            region, origin, along_a, Y_AXIS, limits, (-b, b), cutouts=cut, speckle_shift=(shift, 0.0)
        )

    rise = (side / slope, 0.0, surface.depth_mm / slope)
    fall = (side / slope, 0.0, -surface.depth_mm / slope)
    return (
        strip(1, (-x_base, 0.0, low), base, X_AXIS, -s_base),
        strip(2, (-x_side, 0.0, 0.0), slope, rise, -s_side),
        strip(3, (0.0, 0.0, -low), top, X_AXIS, 0.0, holes),
        strip(4, (x_side, 0.0, 0.0), slope, fall, s_side),
        strip(5, (x_base, 0.0, low), base, X_AXIS, s_base),
    )


def _stiffened_panel(surface: StiffenedPanel) -> tuple[Patch, ...]:
    """Return skin (1), the foot's halves (2: +y, 3: -y), the web's top (4), its sides and the foot's (5 - 8).

    The skin goes on under the foot. Then follow top and side of every stud (9, 10, ...), and the rod.
    """
    width, foot, web = surface.width_mm, surface.foot_width_mm, surface.web_thickness_mm
    thickness, height = surface.foot_thickness_mm, surface.web_height_mm
    half, middle, top = (foot - web) / 2.0, (foot + web) / 4.0, thickness + height
    up: Vector = (0.0, 0.0, 1.0)
    back: Vector = (-1.0, 0.0, 0.0)

    def side(region: int, y: float, low: float, high: float) -> Patch:
        """Return the wall at y, from low to high, facing away from the web's middle."""
        along = back if y > 0.0 else X_AXIS
        return _rectangle(region, (0.0, y, (low + high) / 2.0), width, high - low, along, up)

    return (
        _rectangle(1, (0.0, 0.0, 0.0), width, surface.height_mm),
        _rectangle(2, (0.0, middle, thickness), width, half),
        _rectangle(3, (0.0, -middle, thickness), width, half),
        _rectangle(4, (0.0, 0.0, top), width, web),
        side(5, web / 2.0, thickness, top),
        side(6, -web / 2.0, thickness, top),
        side(7, foot / 2.0, 0.0, thickness),
        side(8, -foot / 2.0, 0.0, thickness),
        *_studs(surface.studs, 9),
        *_rod(surface.rod, 9 + 2 * len(surface.studs)),
    )


def _studs(studs: Sequence[Stud], first: int) -> Iterator[Patch]:
    """Yield top and side of every stud, regions numbered from `first`; each has a print of its own."""
    up: Vector = (0.0, 0.0, 1.0)
    for number, stud in enumerate(studs):
        (x, y), radius, height = stud.centre_mm, stud.radius_mm, stud.height_mm
        region = first + 2 * number
        top = (x, y, stud.level_mm + height)
        limits, around = (-radius, radius), (-pi * radius, pi * radius)
        shifts = ((1000.0 * (region - 1), 0.0), (1000.0 * region, 0.0))
        yield Patch(region, top, X_AXIS, Y_AXIS, limits, limits, rim=radius, speckle_shift=shifts[0])
        foot = (x, y, stud.level_mm)
        yield Patch(
            region + 1, foot, X_AXIS, up, around, (0.0, height), CYLINDER, radius, speckle_shift=shifts[1]
        )


def _rod(rod: TieRod | None, region: int) -> Iterator[Patch]:
    if rod is None:
        return
    around, half = (-pi * rod.radius_mm, pi * rod.radius_mm), rod.length_mm / 2.0
    shift = (1000.0 * (region - 1), 0.0)
    yield Patch(
        region, (rod.x_mm, 0.0, rod.z_mm), X_AXIS, Y_AXIS, around, (-half, half), CYLINDER, rod.radius_mm,
        speckle_shift=shift,
    )  # fmt: skip


def _plate_and_mirror(surface: PlateAndMirror) -> tuple[Patch, ...]:
    """Return the plate (1), on the side of negative x, and the mirror (2); the hinge is the y axis."""
    tilt = (pi - surface.opening_angle_rad) / 2.0
    b = (-surface.height_mm / 2.0, surface.height_mm / 2.0)
    plate = (cos(tilt), 0.0, -sin(tilt))
    mirror = (cos(tilt), 0.0, sin(tilt))
    origin = (0.0, 0.0, 0.0)
    return (
        Patch(1, origin, plate, Y_AXIS, (-surface.plate_width_mm, 0.0), b),
        Patch(
            2,
            origin,
            mirror,
            Y_AXIS,
            (0.0, surface.mirror_width_mm),
            b,
            reflectance=surface.mirror_reflectance,
        ),
    )


@inner
@uncounted_kernel
def step_to_patch(
    patch: Floats, mx: float, my: float, mz: float, vx: float, vy: float, vz: float
) -> tuple[float, bool]:
    """Return how far along v the straight line from m meets the patch's plane or quadric, and if it does.

    On a quadric it is the first of the two meetings; where the line passes by, the closest approach.
    """
    x, y, z = mx - patch[1], my - patch[2], mz - patch[3]
    if patch[0] == PLANE:
        distance = patch[10] * x + patch[11] * y + patch[12] * z
        speed = patch[10] * vx + patch[11] * vy + patch[12] * vz
        return (-distance / speed, True) if speed != 0.0 else (np.inf, False)
    if patch[0] == CYLINDER:
        along = patch[7] * x + patch[8] * y + patch[9] * z
        x, y, z = x - along * patch[7], y - along * patch[8], z - along * patch[9]
        along = patch[7] * vx + patch[8] * vy + patch[9] * vz
        vx, vy, vz = vx - along * patch[7], vy - along * patch[8], vz - along * patch[9]
    a = vx * vx + vy * vy + vz * vz
    b = x * vx + y * vy + z * vz
    under = b * b - a * (x * x + y * y + z * z - patch[13] * patch[13])
    if under < 0.0:
        return -b / a, False
    return (-b - sqrt(under)) / a, True


@inner
@uncounted_kernel
def patch_coordinates(patch: Floats, mx: float, my: float, mz: float) -> tuple[float, float]:
    """Return the material coordinates (a, b) of a material point on the patch, in mm."""
    x, y, z = mx - patch[1], my - patch[2], mz - patch[3]
    a = patch[4] * x + patch[5] * y + patch[6] * z
    b = patch[7] * x + patch[8] * y + patch[9] * z
    if patch[0] == PLANE:
        return a, b
    out = patch[10] * x + patch[11] * y + patch[12] * z
    if patch[0] == CYLINDER:
        return patch[13] * atan2(a, out), b
    stretch = sqrt(2.0 / (1.0 + max(out / patch[13], -0.999999)))
    return a * stretch, b * stretch


@inner
@uncounted_kernel
def patch_normal(patch: Floats, mx: float, my: float, mz: float) -> tuple[float, float, float]:
    """Return the outward unit normal at rest at a material point on the patch."""
    if patch[0] == PLANE:
        return patch[10], patch[11], patch[12]
    x, y, z = mx - patch[1], my - patch[2], mz - patch[3]
    if patch[0] == CYLINDER:
        along = patch[7] * x + patch[8] * y + patch[9] * z
        x, y, z = x - along * patch[7], y - along * patch[8], z - along * patch[9]
    return x / patch[13], y / patch[13], z / patch[13]


@inner
@uncounted_kernel
def near_patch(patch: Floats, a: float, b: float, slack: float) -> bool:
    """Tell whether (a, b) lies within the patch's limits, widened by `slack` in mm."""
    return bool(
        patch[14] - slack <= a <= patch[15] + slack
        and patch[16] - slack <= b <= patch[17] + slack
        and a * a + b * b <= (patch[18] + slack) * (patch[18] + slack)
    )


@inner
@uncounted_kernel
def on_patch(patch: Floats, cutouts: Floats, a: float, b: float) -> bool:
    """Tell whether the patch has material at (a, b)."""
    if not near_patch(patch, a, b, 0.0):
        return False
    for i in range(int(patch[21]), int(patch[22])):
        x, y, half_a, half_b = a - cutouts[i, 0], b - cutouts[i, 1], cutouts[i, 2], cutouts[i, 3]
        if half_b == 0.0:
            if x * x + y * y < half_a * half_a:
                return False
        elif abs(x) < half_a and abs(y) < half_b:
            return False
    return True
