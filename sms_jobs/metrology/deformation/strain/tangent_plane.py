"""Strain in the tangent plane of the reference surface, by least squares over a gauge disc in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.deformation.fields.cells import cell_means
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch

_DISC_CELLS = 8  # cells to a gauge radius, to the nearest whole side: 110 to 350 in a disc


@dataclass(frozen=True)
class SurfaceStrain:
    """Strain at every pixel of the reference image, NaN where the gauge disc holds too few points.

    Attributes
    ----------
    strain, sigma
        (3, rows, columns): xx, yy, xy (tensor component) and their standard deviations.
    principal
        (2, rows, columns), larger first.
    von_mises
        (rows, columns).
    """

    strain: Floats
    sigma: Floats
    principal: Floats
    von_mises: Floats


@kernel
def _principal_axes(
    matrix: Floats,
    vectors: Floats,
) -> None:
    """Turn a symmetric 3 x 3 matrix to diagonal form by Jacobi's rotations; columns of `vectors` are axes."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off <= 1e-16 * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                theta = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    a = matrix[k, p]
                    b = matrix[k, q]
                    matrix[k, p] = c * a - s * b
                    matrix[k, q] = s * a + c * b
                for k in range(3):
                    a = matrix[p, k]
                    b = matrix[q, k]
                    matrix[p, k] = c * a - s * b
                    matrix[q, k] = s * a + c * b
                    a = vectors[k, p]
                    b = vectors[k, q]
                    vectors[k, p] = c * a - s * b
                    vectors[k, q] = s * a + c * b


@kernel
def _tangent_frame(
    scatter: Floats,
    along: Floats,
    x_axis: Floats,
    vectors: Floats,
    frame: Floats,
) -> bool:
    """Fill the frame (rows x, y, z) at a point; return False where it has none.

    z is the direction in which the points scatter least, towards the camera; x is `x_axis` projected onto
    the plane across it. `along` (2, 3) correlates position with the image's x and y, and so tells which
    side the camera is on: the image's x, y and the viewing direction are right-handed.
    """
    _principal_axes(scatter, vectors)
    least, middle, most = 0, 1, 2
    if scatter[middle, middle] < scatter[least, least]:
        least, middle = middle, least
    if scatter[most, most] < scatter[middle, middle]:
        middle, most = most, middle
    if scatter[middle, middle] < scatter[least, least]:
        least, middle = middle, least
    if not scatter[middle, middle] > 1e-2 * scatter[most, most]:
        return False
    z = vectors[:, least]
    facing = (
        z[0] * (along[0, 1] * along[1, 2] - along[0, 2] * along[1, 1])
        + z[1] * (along[0, 2] * along[1, 0] - along[0, 0] * along[1, 2])
        + z[2] * (along[0, 0] * along[1, 1] - along[0, 1] * along[1, 0])
    )
    sign = -1.0 if facing > 0.0 else 1.0
    height = x_axis[0] * z[0] + x_axis[1] * z[1] + x_axis[2] * z[2]
    length = 0.0
    for k in range(3):
        frame[2, k] = sign * z[k]
        frame[0, k] = x_axis[k] - height * z[k]
        length += frame[0, k] ** 2
    if not length > 1e-6:
        return False
    for k in range(3):
        frame[0, k] /= np.sqrt(length)
    for k in range(3):
        a = (k + 1) % 3
        b = (k + 2) % 3
        frame[1, k] = frame[2, a] * frame[0, b] - frame[2, b] * frame[0, a]
    return True


@kernel
def _gather(
    side: int,
    labels: Labels,
    weight: Floats,
    place: Floats,
    xyz: Floats,
    displacement: Floats,
    covariance: Floats,
    normal: Floats,
    least_cosine: float,
    row: int,
    column: int,
    label: int,
    centre: Floats,
    radius: float,
    reach: int,
    sums: Floats,
    scatter: Floats,
    mixed: Floats,
    along: Floats,
) -> float:
    """Fill the central moments of the cells within `radius` of a point of the surface; return their weight.

    Cells whose normal makes an angle with that of the point's own cell beyond `least_cosine` are left out.
    `sums` is the weighted sum of (place 2, xyz 3, displacement 3, covariance 6), `scatter` that of
    position with position, `mixed` of position with displacement, `along` of image place with position.
    """
    sums[:] = 0.0
    scatter[:] = 0.0
    mixed[:] = 0.0
    along[:] = 0.0
    total = 0.0
    own_x = normal[0, row // side, column // side]
    own_y = normal[1, row // side, column // side]
    own_z = normal[2, row // side, column // side]
    folded = least_cosine > -1.0 and own_x * own_x + own_y * own_y + own_z * own_z > 0.0
    for j in range(max(row // side - reach, 0), min(row // side + reach + 1, labels.shape[0])):
        for i in range(max(column // side - reach, 0), min(column // side + reach + 1, labels.shape[1])):
            if labels[j, i] != label:
                continue
            x = (xyz[0, j, i] - centre[0], xyz[1, j, i] - centre[1], xyz[2, j, i] - centre[2])
            if x[0] * x[0] + x[1] * x[1] + x[2] * x[2] > radius * radius:
                continue
            if folded:
                n_x, n_y, n_z = normal[0, j, i], normal[1, j, i], normal[2, j, i]
                square = n_x * n_x + n_y * n_y + n_z * n_z
                if square > 0.0 and n_x * own_x + n_y * own_y + n_z * own_z < least_cosine:
                    continue
            w = weight[j, i]
            total += w
            for a in range(2):
                p = place[a, j, i] - (column if a == 0 else row)
                sums[a] += w * p
                for k in range(3):
                    along[a, k] += w * p * x[k]
            for k in range(3):
                sums[2 + k] += w * x[k]
                sums[5 + k] += w * displacement[k, j, i]
                for m in range(3):
                    scatter[k, m] += w * x[k] * x[m]
                    mixed[k, m] += w * x[k] * displacement[m, j, i]
            for k in range(6):
                sums[8 + k] += w * covariance[k, j, i]
    for k in range(3):
        for a in range(2):
            along[a, k] -= sums[a] * sums[2 + k] / total
        for m in range(3):
            scatter[k, m] -= sums[2 + k] * sums[2 + m] / total
            mixed[k, m] -= sums[2 + k] * sums[5 + m] / total
    return total


@kernel
def _quadratic(
    a: Floats,
    packed: Floats,
    b: Floats,
) -> float:
    """Return a^T C b for a packed symmetric C."""
    return float(
        a[0] * (packed[0] * b[0] + packed[1] * b[1] + packed[2] * b[2])
        + a[1] * (packed[1] * b[0] + packed[3] * b[1] + packed[4] * b[2])
        + a[2] * (packed[2] * b[0] + packed[4] * b[1] + packed[5] * b[2])
    )


@kernel
def _slopes(frame: Floats, scatter: Floats, mixed: Floats, gradient: Floats) -> tuple[float, float, float]:
    """Fill the slopes (2, 3) of the displacement along e_x and e_y: d,a = A^-1 T^T (mixed).

    Returns 00, 01 and 11 of the inverse of A, the points' scatter in the plane.
    """
    spread = np.zeros((2, 2))
    for a in range(2):
        for b in range(2):
            for k in range(3):
                for m in range(3):
                    spread[a, b] += frame[a, k] * scatter[k, m] * frame[b, m]
    determinant = spread[0, 0] * spread[1, 1] - spread[0, 1] * spread[1, 0]
    i00 = spread[1, 1] / determinant
    i11 = spread[0, 0] / determinant
    i01 = -spread[0, 1] / determinant
    for m in range(3):
        bx = frame[0, 0] * mixed[0, m] + frame[0, 1] * mixed[1, m] + frame[0, 2] * mixed[2, m]
        by = frame[1, 0] * mixed[0, m] + frame[1, 1] * mixed[1, m] + frame[1, 2] * mixed[2, m]
        gradient[0, m] = i00 * bx + i01 * by
        gradient[1, m] = i01 * bx + i11 * by
    return i00, i01, i11


@kernel
def _strain_of(frame: Floats, gradient: Floats, green: bool, f: Floats) -> tuple[float, float, float]:
    """Return xx, yy and xy, and fill what e_x and e_y become, (2, 3): themselves for small strain."""
    xx = yy = xy = 0.0
    for m in range(3):
        xx += frame[0, m] * gradient[0, m]
        yy += frame[1, m] * gradient[1, m]
        xy += 0.5 * (frame[0, m] * gradient[1, m] + frame[1, m] * gradient[0, m])
        if green:
            xx += 0.5 * gradient[0, m] ** 2
            yy += 0.5 * gradient[1, m] ** 2
            xy += 0.5 * gradient[0, m] * gradient[1, m]
        for a in range(2):
            f[a, m] = frame[a, m] + (gradient[a, m] if green else 0.0)
    return xx, yy, xy


@kernel
def _sigma_of(f: Floats, noise: Floats, inverse: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the standard deviations of xx, yy and xy from the covariance of the displacement, packed."""
    i00, i01, i11 = inverse
    nxx = _quadratic(f[0], noise, f[0])
    nyy = _quadratic(f[1], noise, f[1])
    nxy = _quadratic(f[0], noise, f[1])
    shear = 0.5 * np.sqrt(i11 * nxx + i00 * nyy + 2.0 * i01 * nxy)
    return np.sqrt(i00 * nxx), np.sqrt(i11 * nyy), shear


@kernel
def _strain_rows(
    start: int,
    stop: int,
    valid: Mask,
    full_xyz: Floats,
    full_labels: Labels,
    side: int,
    labels: Labels,
    weight: Floats,
    place: Floats,
    xyz: Floats,
    displacement: Floats,
    covariance: Floats,
    normal: Floats,
    least_cosine: float,
    x_axis: Floats,
    radius: float,
    reach: int,
    minimum: int,
    green: bool,
    strain: Floats,
    sigma: Floats,
) -> None:
    """Fill strain and sigma for rows start .. stop."""
    sums = np.empty(14)
    scatter = np.empty((3, 3))
    turned = np.empty((3, 3))
    mixed = np.empty((3, 3))
    along = np.empty((2, 3))
    vectors = np.empty((3, 3))
    frame = np.empty((3, 3))
    gradient = np.empty((2, 3))
    f = np.empty((2, 3))
    for r in range(start, stop):
        for c in range(valid.shape[1]):
            strain[:, r, c] = np.nan
            sigma[:, r, c] = np.nan
            if not valid[r, c]:
                continue
            total = _gather(
                side, labels, weight, place, xyz, displacement, covariance, normal, least_cosine, r, c,
                full_labels[r, c], full_xyz[:, r, c], radius, reach, sums, scatter, mixed, along,
            )  # fmt: skip
            if not total >= minimum:
                continue
            for i in range(3):
                for j in range(3):
                    turned[i, j] = scatter[i, j]
            if not _tangent_frame(turned, along, x_axis, vectors, frame):
                continue
            inverse = _slopes(frame, scatter, mixed, gradient)
            xx, yy, xy = _strain_of(frame, gradient, green, f)
            strain[0, r, c], strain[1, r, c], strain[2, r, c] = xx, yy, xy
            xx, yy, xy = _sigma_of(f, sums[8:] / total, inverse)
            sigma[0, r, c], sigma[1, r, c], sigma[2, r, c] = xx, yy, xy


def principal_and_equivalent(strain: Floats) -> tuple[Floats, Floats]:
    """Return the principal strains (2, ...), larger first, and the equivalent strain (...) of xx, yy, xy."""
    xx, yy, xy = strain
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    first, second = middle + half, middle - half
    return np.stack([first, second]), np.sqrt(first**2 - first * second + second**2)


def surface_strain(
    xyz: Floats,
    displacement: Floats,
    covariance: NDArray[np.floating],
    labels: NDArray[np.int32],
    *,
    gauge_length: float,
    x_axis: tuple[float, float, float] = (1.0, 0.0, 0.0),
    green_lagrange: bool = True,
    minimum_pixels: int = 12,
    fold_angle_rad: float = np.pi,
    threads: int = 1,
) -> SurfaceStrain:
    """Return the in-plane strain at every pixel that has a displacement.

    Parameters
    ----------
    xyz
        (3, rows, columns), positions at the reference state, in any unit of length.
    displacement, covariance
        (3, rows, columns) and (6, rows, columns) in that unit; NaN where there is none.
    labels
        (rows, columns), continuous regions; a gauge disc holds points of its centre's region only.
    gauge_length
        Diameter of the gauge disc, a ball's cut with the surface.
    x_axis
        Unit vector in the world whose projection onto the surface is the strain's x.
    green_lagrange
        True for Green-Lagrange strain, False for small strain.
    minimum_pixels
        A disc with fewer pixels gives no strain.
    fold_angle_rad
        A disc ends where the surface's normal differs by more than this from that at its centre: strain does
        not reach across a fold, where displacement has a kink. pi for no such limit.
    threads
        How many threads to use; the result does not depend on it.

    Notes
    -----
    With d,a the least-squares slopes of the displacement along e_x and e_y of the tangent plane,
    E_ab = (e_a . d,b + e_b . d,a + d,a . d,b) / 2 (Green-Lagrange), without the last term thesis Eq. (5.1).
    The plane is that of the points' principal axes, in which height is uncorrelated with place: a rigid
    motion therefore gives no Green-Lagrange strain at all on any surface, and a lopsided disc at an edge
    gives the strain at its centroid. The equivalent strain is sqrt(e1^2 - e1 e2 + e2^2) of the principal
    strains e1 and e2. The standard deviation takes errors as independent from pixel to pixel: see
    `strain_errors.independent_equivalent` for those that are not.
    """
    valid = np.isfinite(displacement).all(axis=0) & (labels > 0)
    used = np.where(valid, labels, 0).astype(np.int32)
    radius = 0.5 * gauge_length
    reach_px = radius / pixel_pitch(xyz, used, 0.01)
    side = max(1, round(reach_px / _DISC_CELLS))
    cells = cell_means(xyz, displacement, np.asarray(covariance, dtype=np.float64), used, side)
    reach = int(np.ceil(reach_px / side))
    axis = np.asarray(x_axis, dtype=np.float64)
    strain = np.empty((3, *labels.shape))
    sigma = np.empty((3, *labels.shape))

    def work(start: int, stop: int) -> None:
        _strain_rows(
            start, stop, valid, xyz, used, cells.side, cells.labels, cells.weight, cells.place, cells.xyz,
            cells.displacement, cells.covariance, cells.normal, float(np.cos(fold_angle_rad)), axis, radius,
            reach, minimum_pixels, green_lagrange, strain, sigma,
        )  # fmt: skip

    in_row_blocks(work, labels.shape[0], threads)
    return SurfaceStrain(strain, sigma, *principal_and_equivalent(strain))
