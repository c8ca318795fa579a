"""What is done to a specimen: exact maps of material points to the world, their inverses and gradients.

Deformations act one after the other in the specimen's frame; the placement in the world comes last. Each
has an exact inverse, so that a ray of light can be followed back to the specimen at rest.

Kernels take the maps as rows of an array: code 0, then for an affine map x -> A x + b the matrix 1 - 9,
b 10 - 12 and the inverse matrix 13 - 21; for bending deflection, width, height 1 - 3; for halves apart
the gap 1; for a disbond gap, length, tilt and level 1 - 4; for a bow those along x and y and the twist 1 - 3,
the centre 4 - 5 and half of the sides 6 - 7; for a stringer's crack strain, Poisson's ratio, slope, tip,
fade, stringer, width, relief and bulge 1 - 9.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.stage.pan_tilt import stage_rotation
from sms_jobs.metrology.compilation import inner, uncounted_kernel
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.records.scene import (
    Bow,
    Deformation,
    Disbond,
    HalvesApart,
    MidPointBending,
    PanTilt,
    Rigid,
    StringerCrack,
    UniaxialStrain,
    refuse_inside_out,
)

AFFINE, BENDING, HALVES, DISBOND, BOW, CRACK = 0, 1, 2, 3, 4, 5


def packed_chain(deformation: Iterable[Deformation], placement: Pose) -> Floats:
    """Return the maps from the specimen at rest to the world, in order, as kernels take them, (n, 22)."""
    rows = [_packed(d) for d in deformation]
    rows.append(_affine(placement.matrix(), np.array(placement.translation)))
    return np.array(rows)


def bending_slack(deformation: Iterable[Deformation]) -> float:
    """Return how far, in mm, the deformations may move a point off their best affine map."""
    slack = 0.0
    for d in deformation:
        if isinstance(d, MidPointBending):
            slack += abs(d.deflection_mm)
        elif isinstance(d, HalvesApart):
            slack += abs(d.gap_mm)
        elif isinstance(d, Disbond):
            slack += 2.0 * abs(d.gap_mm)
        elif isinstance(d, StringerCrack):
            # Beyond the bulge less than half of the strain over the farthest of a metre.
            slack += abs(d.bulge_mm) + 500.0 * abs(d.strain)
        elif isinstance(d, Bow):
            # At the plate's edge, up to twice as far from the middle as its points.
            slack += 4.0 * (abs(d.x_mm) + abs(d.y_mm) + abs(d.twist_mm))
    return slack


def _packed(deformation: Deformation) -> Floats:
    refuse_inside_out(deformation)
    if isinstance(deformation, Rigid):
        rotation = Rotation.from_rotvec(deformation.rotation_rad).as_matrix()
        return _affine(rotation, np.array(deformation.translation_mm))
    if isinstance(deformation, PanTilt):
        return _affine(stage_rotation(deformation.pan_rad, deformation.tilt_rad), np.zeros(3))
    if isinstance(deformation, UniaxialStrain):
        across = 1.0 - deformation.poisson_ratio * deformation.strain
        return _affine(np.diag([1.0 + deformation.strain, across, across]), np.zeros(3))
    row = np.zeros(22)
    if isinstance(deformation, MidPointBending):
        row[:4] = BENDING, deformation.deflection_mm, deformation.width_mm, deformation.height_mm
    elif isinstance(deformation, Disbond):
        row[:5] = (
            DISBOND, deformation.gap_mm, deformation.length_mm, deformation.tilt_per_mm, deformation.level_mm
        )  # fmt: skip
    elif isinstance(deformation, Bow):
        row[:4] = BOW, deformation.x_mm, deformation.y_mm, deformation.twist_mm
        row[4:8] = *deformation.centre_mm, deformation.half_width_mm, deformation.half_height_mm
    elif isinstance(deformation, StringerCrack):
        d = deformation
        row[:10] = (
            CRACK, d.strain, d.poisson_ratio, d.slope_per_mm, d.tip_mm, d.fade_mm, d.stringer_mm, d.width_mm,
            d.relief, d.bulge_mm,
        )  # fmt: skip
    else:
        row[:2] = HALVES, deformation.gap_mm
    return row


def _affine(matrix: Floats, shift: Floats) -> Floats:
    return np.concatenate([[AFFINE], matrix.ravel(), shift, np.linalg.inv(matrix).ravel()])


@inner
@uncounted_kernel
def deflection_line(s: float) -> tuple[float, float]:
    """Return f(s) = 1 - 12 s^2 + 16 |s|^3 and its slope; both are 0 beyond |s| = 1/2."""
    r = abs(s)
    if r >= 0.5:
        return 0.0, 0.0
    return 1.0 + r * r * (16.0 * r - 12.0), s * (48.0 * r - 24.0)


@inner
@uncounted_kernel
def _lift(m: Floats, x: float, y: float) -> tuple[float, float, float]:
    """Return how far a disbond lifts the stringer at (x, y), and the slopes of that along x and y."""
    f, df = deflection_line(x / m[2])
    tilted = 1.0 + m[3] * y
    return m[1] * f * tilted, m[1] * df / m[2] * tilted, m[1] * f * m[3]


@inner
@uncounted_kernel
def _height(m: Floats, x: float, y: float) -> tuple[float, float, float]:
    """Return how far a bow moves (x, y) out, and the slopes of that along x and y."""
    u, v = (x - m[4]) / m[6], (y - m[5]) / m[7]
    along, across = 2.0 * m[1] * u + m[3] * v, 2.0 * m[2] * v + m[3] * u
    return m[1] * u * u + m[2] * v * v + m[3] * u * v, along / m[6], across / m[7]


@inner
@uncounted_kernel
def _over_stringer(
    m: Floats, x: float, y: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the displacement of a stringer's crack at (x, y), and the slopes of its components, x then y."""
    e, nu, t = m[1], m[2], m[3]
    s, off = (x - m[4]) / m[5], y - m[6]
    part = 0.5 * (1.0 + np.tanh(s))
    grown = 0.5 * (s + abs(s) + np.log1p(np.exp(-2.0 * abs(s))))
    about = np.exp(-0.5 * off * off / (m[7] * m[7]))
    falls = -off / (m[7] * m[7]) * about
    more = e * m[8]
    return (
        e * x * (1.0 + t * y) + more * m[5] * grown * about,
        -nu * e * y * (1.0 + 0.5 * t * y) - 0.5 * e * t * x * x,
        m[9] * part * about,
        e * (1.0 + t * y) + more * part * about,
        e * x * t + more * m[5] * grown * falls,
        -e * t * x,
        -nu * e * (1.0 + t * y),
        m[9] * 2.0 * part * (1.0 - part) / m[5] * about,
        m[9] * part * falls,
    )


@inner
@uncounted_kernel
def _share(z: float, level: float) -> tuple[float, float]:
    """Return which part of a disbond's lift is that of material at height z, and its slope along z."""
    if z <= 0.0:
        return 0.0, 0.0
    return (1.0, 0.0) if z >= level else (z / level, 1.0 / level)


@inner
@uncounted_kernel
def carried(
    chain: Floats, x: float, y: float, z: float, nx: float, ny: float, nz: float
) -> tuple[float, float, float, float, float, float]:
    """Carry a material point to the world, and with it a normal (not normalised).

    A normal is carried by the inverse transpose of the map's gradient.
    """
    for i in range(chain.shape[0]):
        m = chain[i]
        if m[0] == AFFINE:
            x, y, z = (
                m[1] * x + m[2] * y + m[3] * z + m[10],
                m[4] * x + m[5] * y + m[6] * z + m[11],
                m[7] * x + m[8] * y + m[9] * z + m[12],
            )
            nx, ny, nz = (
                m[13] * nx + m[16] * ny + m[19] * nz,
                m[14] * nx + m[17] * ny + m[20] * nz,
                m[15] * nx + m[18] * ny + m[21] * nz,
            )
        elif m[0] == BENDING:
            f, df = deflection_line(x / m[2])
            g, dg = deflection_line(y / m[3])
            z += m[1] * f * g
            nx -= m[1] * df / m[2] * g * nz
            ny -= m[1] * f * dg / m[3] * nz
        elif m[0] == DISBOND:
            lift, along, across = _lift(m, x, y)
            share, slope = _share(z, m[4])
            z += lift * share
            nz /= 1.0 + lift * slope
            nx -= along * share * nz
            ny -= across * share * nz
        elif m[0] == BOW:
            height, along, across = _height(m, x, y)
            z += height
            nx -= along * nz
            ny -= across * nz
        elif m[0] == CRACK:
            dx, dy, dz, xx, xy, yx, yy, zx, zy = _over_stringer(m, x, y)
            x, y, z = x + dx, y + dy, z + dz
            nx, ny = nx - zx * nz, ny - zy * nz
            whole = (1.0 + xx) * (1.0 + yy) - xy * yx
            nx, ny = ((1.0 + yy) * nx - yx * ny) / whole, ((1.0 + xx) * ny - xy * nx) / whole
        elif x < 0.0:
            x -= 0.5 * m[1]
        else:
            x += 0.5 * m[1]
    return x, y, z, nx, ny, nz


@inner
@uncounted_kernel
def followed_back(
    chain: Floats, x: float, y: float, z: float, vx: float, vy: float, vz: float
) -> tuple[float, float, float, float, float, float, bool]:
    """Carry a point of the world and a direction back to the specimen at rest: the inverse of `carried`.

    The last value is False in a gap between halves, which comes from no material; the point is then
    taken to the edge of the gap.
    """
    material = True
    for i in range(chain.shape[0] - 1, -1, -1):
        m = chain[i]
        if m[0] == AFFINE:
            x, y, z = x - m[10], y - m[11], z - m[12]
            x, y, z = (
                m[13] * x + m[14] * y + m[15] * z,
                m[16] * x + m[17] * y + m[18] * z,
                m[19] * x + m[20] * y + m[21] * z,
            )
            vx, vy, vz = (
                m[13] * vx + m[14] * vy + m[15] * vz,
                m[16] * vx + m[17] * vy + m[18] * vz,
                m[19] * vx + m[20] * vy + m[21] * vz,
            )
        elif m[0] == BENDING:
            f, df = deflection_line(x / m[2])
            g, dg = deflection_line(y / m[3])
            z -= m[1] * f * g
            vz -= m[1] * (df / m[2] * g * vx + f * dg / m[3] * vy)
        elif m[0] == DISBOND:
            lift, along, across = _lift(m, x, y)
            z = z - lift if z >= m[4] + lift else min(z, z * m[4] / (m[4] + lift))
            share, slope = _share(z, m[4])
            vz = (vz - share * (along * vx + across * vy)) / (1.0 + lift * slope)
        elif m[0] == BOW:
            height, along, across = _height(m, x, y)
            z -= height
            vz -= along * vx + across * vy
        elif m[0] == CRACK:
            endx, endy = x, y
            dx, dy, dz, xx, xy, yx, yy, zx, zy = _over_stringer(m, x, y)
            for _ in range(12):
                # Slopes are strains, some thousandths: every round makes the error that much smaller.
                before = dx, dy
                x, y = endx - dx, endy - dy
                dx, dy, dz, xx, xy, yx, yy, zx, zy = _over_stringer(m, x, y)
                if before == (dx, dy):
                    break
            z -= dz
            whole = (1.0 + xx) * (1.0 + yy) - xy * yx
            vx, vy = ((1.0 + yy) * vx - xy * vy) / whole, ((1.0 + xx) * vy - yx * vx) / whole
            vz -= zx * vx + zy * vy
        else:
            half = 0.5 * m[1]
            if abs(x) < half:
                material = False
                x = 0.0
            elif x < 0.0:
                x += half
            else:
                x -= half
    return x, y, z, vx, vy, vz, material


@uncounted_kernel
def _carry_all(chain: Floats, points: Floats, out: Floats) -> None:
    for i in range(points.shape[0]):
        out[i, 0], out[i, 1], out[i, 2], _, _, _ = carried(
            chain, points[i, 0], points[i, 1], points[i, 2], 0.0, 0.0, 0.0
        )


@uncounted_kernel
def _slopes_over_stringer(m: Floats, points: Floats, out: Floats) -> None:
    for i in range(points.shape[0]):
        _, _, _, xx, xy, yx, yy, zx, zy = _over_stringer(m, points[i, 0], points[i, 1])
        out[i, 0, 0], out[i, 0, 1] = xx, xy
        out[i, 1, 0], out[i, 1, 1] = yx, yy
        out[i, 2, 0], out[i, 2, 1] = zx, zy


def carried_points(chain: Floats, material: Floats) -> Floats:
    """Return where material points lie in the world, (n, 3) to (n, 3) in mm; NaN stays NaN."""
    out = np.empty_like(material)
    _carry_all(chain, np.ascontiguousarray(material), out)
    return out


def gradients(chain: Floats, material: Floats) -> Floats:
    """Return d(world)/d(material) of material points (n, 3), (n, 3, 3), dimensionless."""
    x = np.array(material, dtype=np.float64)
    total = np.broadcast_to(np.eye(3), (len(x), 3, 3)).copy()
    for i, row in enumerate(chain):
        if row[0] == AFFINE:
            total = row[1:10].reshape(3, 3) @ total
        elif row[0] == BENDING:
            deflection, width, height = row[1:4]
            f, df = _deflection_lines(x[:, 0] / width)
            g, dg = _deflection_lines(x[:, 1] / height)
            slope = deflection * np.stack([df * g / width, f * dg / height], axis=-1)
            total[:, 2] += np.einsum("ni,nij->nj", slope, total[:, :2])
        elif row[0] == DISBOND:
            gap, length, tilt, level = row[1:5]
            f, df = _deflection_lines(x[:, 0] / length)
            share = np.clip(x[:, 2] / level, 0.0, 1.0)
            inside = (x[:, 2] > 0.0) & (x[:, 2] < level)
            tilted = 1.0 + tilt * x[:, 1]
            slope = gap * share[:, None] * np.stack([df * tilted / length, f * tilt], axis=-1)
            stretch = 1.0 + np.where(inside, gap * f * tilted / level, 0.0)
            total[:, 2] = stretch[:, None] * total[:, 2] + np.einsum("ni,nij->nj", slope, total[:, :2])
        elif row[0] == BOW:
            u, v = (x[:, 0] - row[4]) / row[6], (x[:, 1] - row[5]) / row[7]
            along, across = 2.0 * row[1] * u + row[3] * v, 2.0 * row[2] * v + row[3] * u
            slope = np.stack([along / row[6], across / row[7]], axis=-1)
            total[:, 2] += np.einsum("ni,nij->nj", slope, total[:, :2])
        elif row[0] == CRACK:
            slopes = np.empty((len(x), 3, 2))
            _slopes_over_stringer(row, np.ascontiguousarray(x), slopes)
            total = total + slopes @ total[:, :2]
        x = carried_points(chain[i : i + 1], x)
    return total


def _deflection_lines(s: Floats) -> tuple[Floats, Floats]:
    r = np.minimum(np.abs(s), 0.5)
    return 1.0 + r * r * (16.0 * r - 12.0), np.sign(s) * r * (48.0 * r - 24.0)
