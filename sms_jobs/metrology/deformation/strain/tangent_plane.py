"""Strain in the tangent plane of the reference surface, by least squares over a gauge disc in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel, variable
from sms_jobs.metrology.deformation.fields.cells import Cells, cell_means
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.metrology.deformation.strain.disc_sums import (
    COVARIANCE,
    NORMAL,
    ROWS,
    SUMS,
    central_moments,
    disc_sums,
    gather,
    told_of_cells,
)
from sms_jobs.metrology.deformation.strain.edge_noise import edges_of, noise_at_edges
from sms_jobs.metrology.deformation.strain.gauge_bias import (
    SHORTER,
    STEPS_TO_A_RADIUS,
    Samples,
    gauge_bias,
    spread_over_pixels,
)
from sms_jobs.metrology.deformation.strain.strain_errors import SharedErrors
from sms_jobs.metrology.deformation.strain.tangent_frame import tangent_frame

LEAST_PIXELS = 12
"""With fewer in its disc no pixel has a strain."""
_DISC_CELLS = 8  # cells to a gauge radius, to the nearest whole side: 110 to 350 in a disc
_BLOCK = 4  # px: squares of this side, or of a cell, look among the same cells


@dataclass(frozen=True)
class SurfaceStrain:
    """Strain at every pixel of the reference image, NaN where the gauge disc holds too few points.

    Attributes
    ----------
    strain, sigma
        (3, rows, columns): xx, yy, xy (tensor component) and their standard deviations.
    bias
        (3, rows, columns), the part of these that is no noise: strain that bends within the disc.
    principal
        (2, rows, columns), larger first.
    von_mises
        (rows, columns).
    """

    strain: Floats
    sigma: Floats
    bias: Floats
    principal: Floats
    von_mises: Floats


@inner
@uncounted_kernel
def _slopes(frame: Floats, scatter: Floats, mixed: Floats, gradient: Floats) -> tuple[float, float, float]:
    """Fill the slopes (2, 3) of the displacement along e_x and e_y: d,a = A^-1 T^T (mixed).

    Returns 00, 01 and 11 of the inverse of A, the points' scatter in the plane.
    """
    xx = xy = yy = 0.0
    for k in range(3):
        for m in range(3):
            xx += frame[0, k] * scatter[k, m] * frame[0, m]
            xy += frame[0, k] * scatter[k, m] * frame[1, m]
            yy += frame[1, k] * scatter[k, m] * frame[1, m]
    determinant = xx * yy - xy * xy
    i00, i01, i11 = yy / determinant, -xy / determinant, xx / determinant
    for m in range(3):
        bx = frame[0, 0] * mixed[0, m] + frame[0, 1] * mixed[1, m] + frame[0, 2] * mixed[2, m]
        by = frame[1, 0] * mixed[0, m] + frame[1, 1] * mixed[1, m] + frame[1, 2] * mixed[2, m]
        gradient[0, m] = i00 * bx + i01 * by
        gradient[1, m] = i01 * bx + i11 * by
    return i00, i01, i11


@inner
@uncounted_kernel
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


@inner
@uncounted_kernel
def _variance_of(
    f: Floats, noise: Floats, first: int, inverse: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return the variances of xx, yy and xy from the displacement's covariance, packed from `first` on."""
    i00, i01, i11 = inverse
    xx, xy, xz = noise[first], noise[first + 1], noise[first + 2]
    yy, yz, zz = noise[first + 3], noise[first + 4], noise[first + 5]
    x0, x1, x2 = (
        xx * f[0, 0] + xy * f[0, 1] + xz * f[0, 2],
        xy * f[0, 0] + yy * f[0, 1] + yz * f[0, 2],
        xz * f[0, 0] + yz * f[0, 1] + zz * f[0, 2],
    )
    nxx = f[0, 0] * x0 + f[0, 1] * x1 + f[0, 2] * x2
    nxy = f[1, 0] * x0 + f[1, 1] * x1 + f[1, 2] * x2
    y0, y1, y2 = (
        xx * f[1, 0] + xy * f[1, 1] + xz * f[1, 2],
        xy * f[1, 0] + yy * f[1, 1] + yz * f[1, 2],
        xz * f[1, 0] + yz * f[1, 1] + zz * f[1, 2],
    )
    nyy = f[1, 0] * y0 + f[1, 1] * y1 + f[1, 2] * y2
    return i00 * nxx, i11 * nyy, 0.25 * (i11 * nxx + i00 * nyy + 2.0 * i01 * nxy)


@kernel
def _strain_rows(
    start: int,
    stop: int,
    valid: Mask,
    full_xyz: Floats,
    full_labels: Labels,
    side: int,
    told: Floats,
    least_cosine: float,
    x_axis: Floats,
    radius: float,
    reach: int,
    minimum: int,
    green: bool,
    step: int,
    block: int,
    shared: NDArray[np.float32],
    strain: Floats,
    own: Floats,
    match: Floats,
) -> None:
    """Fill strain and its variances, of every `step`-th pixel from its half on, for their rows start .. stop.

    `own` is that by the covariance, `match` that by `shared` (6, rows, columns). Squares of `block` pixels
    look among the same cells, wherever the rows begin.
    """
    first = step // 2
    near = np.empty((ROWS, (2 * reach + 2 + (block * step) // side) ** 2))
    sums = np.empty(SUMS)
    scatter, turned, mixed = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    vectors, frame = np.empty((3, 3)), np.empty((3, 3))
    gradient, f, here = np.empty((2, 3)), np.empty((2, 3)), np.empty(6)
    for j in range(start // block, (stop - 1) // block + 1):
        for i in range((strain.shape[2] - 1) // block + 1):
            count = -1
            for row in range(max(j * block, start), min((j + 1) * block, stop)):
                for column in range(i * block, min((i + 1) * block, strain.shape[2])):
                    strain[:, row, column] = own[:, row, column] = match[:, row, column] = np.nan
                    r, c = first + step * row, first + step * column
                    if not valid[r, c]:
                        continue
                    if count < 0:
                        count = gather(
                            told,
                            (first + step * j * block) // side - reach,
                            (first + step * ((j + 1) * block - 1)) // side + reach + 1,
                            (first + step * i * block) // side - reach,
                            (first + step * ((i + 1) * block - 1)) // side + reach + 1,
                            near,
                        )
                    y, x = r // side, c // side
                    place = (full_xyz[0, r, c], full_xyz[1, r, c], full_xyz[2, r, c])
                    normal = (told[14, y, x], told[15, y, x], told[16, y, x])
                    least = -2.0 if told[17, y, x] != 0.0 else least_cosine
                    disc_sums(near, count, full_labels[r, c], place, radius * radius, normal, least, sums)
                    if not sums[0] >= minimum:
                        continue
                    central_moments(sums, scatter, mixed)
                    for k in range(3):
                        for m in range(3):
                            turned[k, m] = scatter[k, m]
                    if not tangent_frame(
                        turned, (sums[NORMAL], sums[NORMAL + 1], sums[NORMAL + 2]), x_axis, vectors, frame
                    ):
                        continue
                    inverse = _slopes(frame, scatter, mixed, gradient)
                    strained = _strain_of(frame, gradient, green, f)
                    of_own = _variance_of(f, sums, variable(COVARIANCE), inverse)
                    for k in range(6):
                        here[k] = shared[k, r, c]
                    of_match = _variance_of(f, here, variable(0), inverse)
                    for k in range(3):
                        strain[k, row, column] = strained[k]
                        own[k, row, column] = of_own[k] / sums[0]
                        match[k, row, column] = of_match[k]


def principal_and_equivalent(strain: Floats) -> tuple[Floats, Floats]:
    """Return the principal strains (2, ...), larger first, and the equivalent strain (...) of xx, yy, xy."""
    xx, yy, xy = strain
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    first, second = middle + half, middle - half
    return np.stack([first, second]), np.sqrt(first**2 - first * second + second**2)


def surface_strain(
    xyz: Floats,
    displacement: Floats,
    errors: NDArray[np.floating] | SharedErrors,
    labels: NDArray[np.int32],
    *,
    gauge_length: float,
    x_axis: tuple[float, float, float] = (1.0, 0.0, 0.0),
    green_lagrange: bool = True,
    minimum_pixels: int = LEAST_PIXELS,
    fold_angle_rad: float = np.pi,
    threads: int = 1,
) -> SurfaceStrain:
    """Return the in-plane strain at every pixel that has a displacement.

    Parameters
    ----------
    xyz
        (3, rows, columns), positions at the reference state, in any unit of length.
    displacement
        (3, rows, columns) in that unit; NaN where there is none.
    errors
        What is known of its errors: (6, rows, columns), their covariance, if they are independent from pixel
        to pixel, and otherwise how far they go together.
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
    strains e1 and e2. The standard deviation counts noise, with what edges add to it (`noise_at_edges`),
    and what bends within the disc (`gauge_bias`).
    """
    valid = np.isfinite(displacement).all(axis=0) & (labels > 0)
    used = np.where(valid, labels, 0).astype(np.int32)
    radius = 0.5 * gauge_length
    reach_px = radius / pixel_pitch(xyz, used, 0.01)
    if not isinstance(errors, SharedErrors):
        independent = np.asarray(errors, dtype=np.float64)
        errors = SharedErrors(independent, np.zeros(independent.shape, np.float32), 0.0, 0.0, reach_px)
    cells = _cells_for(reach_px, xyz, displacement, errors.own, used)
    axis = np.asarray(x_axis, dtype=np.float64)
    least_cosine = float(np.cos(fold_angle_rad))
    edges = edges_of(labels, cells, axis, errors)

    def fitted(cells: Cells, part: float, step: int) -> tuple[Floats, Floats]:
        """Return strain over a part of the length and its variance by noise, of every `step`-th pixel."""
        side, told = cells.side, told_of_cells(cells)
        shape = [len(range(step // 2, size, step)) for size in labels.shape]
        strain, own, match = (np.empty((3, *shape)) for _ in range(3))
        reach = int(np.ceil(part * reach_px / side))
        block = max(side, _BLOCK) if step == 1 else 1

        def work(start: int, stop: int) -> None:
            _strain_rows(
                start, stop, valid, xyz, used, side, told, least_cosine, axis, part * radius, reach,
                minimum_pixels, green_lagrange, step, block, errors.match, strain, own, match,
            )  # fmt: skip

        in_row_blocks(work, shape[0], threads)
        of_own, of_match = errors.seen_by_part(part)
        own, match = of_own * own, of_match * match
        return strain, noise_at_edges(own, match, edges.sampled(step), errors, part, threads)

    strain, variance = fitted(cells, 1.0, 1)
    step = max(1, int(np.ceil(reach_px / STEPS_TO_A_RADIUS)))
    every = [(strain, variance)]
    for part in SHORTER:
        finer = _cells_for(part * reach_px, xyz, displacement, errors.own, used)
        every.append(fitted(finer, part, step))
    samples = _sampled(xyz, used, cells, every, step)
    of_gauge = gauge_bias(samples, radius, int(np.ceil(reach_px / step)), least_cosine, threads)
    square = spread_over_pixels(of_gauge, samples, used, threads)
    square[np.isnan(variance)] = np.nan
    sigma = np.sqrt(variance + square)
    return SurfaceStrain(strain, sigma, np.sqrt(square), *principal_and_equivalent(strain))


def _cells_for(
    reach_px: float, xyz: Floats, displacement: Floats, covariance: Floats, labels: Labels
) -> Cells:
    """Return the squares of pixels of which discs with a radius of `reach_px` are made."""
    side = max(1, round(reach_px / _DISC_CELLS))
    return cell_means(xyz, displacement, covariance, labels, side)


def _sampled(
    xyz: Floats, labels: Labels, cells: Cells, strain: Sequence[tuple[Floats, Floats]], step: int
) -> Samples:
    """Return every `step`-th pixel of an image.

    `strain` is that of all pixels, and of the sampled ones over shorter gauges, each with its variance by
    noise.
    """
    first = step // 2
    row, column = (np.arange(first, size, step) // cells.side for size in labels.shape)
    (own, variance), *shorter = strain
    return Samples(
        step,
        first,
        np.ascontiguousarray(xyz[:, first::step, first::step]),
        np.ascontiguousarray(cells.normal[:, row[:, None], column]),
        np.ascontiguousarray(labels[first::step, first::step]),
        np.ascontiguousarray(own[:, first::step, first::step]),
        np.ascontiguousarray(variance[:, first::step, first::step]),
        tuple(shorter),
    )
