"""Strain over squares of pixels: lines fitted along each row and each column, and their slopes averaged.

The thesis's estimator (section 6.2.5). It fits displacement against x along rows that lie along x. Here
displacement and position are both fitted against the pixel, along rows and along columns, and the chain rule
leads to derivatives in the tangent plane: where rows lie along x that is the thesis's, and elsewhere it is
exact still, on any plane.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.deformation.fields.cells import Cells, cell_means
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.metrology.deformation.strain.edge_noise import edges_of, noise_at_edges
from sms_jobs.metrology.deformation.strain.gauge_bias import (
    SHORTER,
    STEPS_TO_A_RADIUS,
    Samples,
    gauge_bias,
    spread_over_pixels,
)
from sms_jobs.metrology.deformation.strain.strain_errors import SharedErrors
from sms_jobs.metrology.deformation.strain.tangent_plane import SurfaceStrain, principal_and_equivalent

LEAST_PART = 0.5
"""Part of a square's pixels that it needs."""

_CELLS = 4  # cells to a side, of which the surface's normals are told
_SPREAD, _COVARIANCE, _FOUND = 12, 14, 20  # of what is found of a square, see `_square_rows`
_PART_BY_NOISE = 0.63  # as of a disc: of a square's strain less the mean of it in the disc about the square
_SKEW = 1e-2  # least sine of the angle between rows and columns on the surface


def radius_of_equal_spread(side: float) -> float:
    """Return the radius of the disc in which points scatter as in a square of a side."""
    return side / float(np.sqrt(3.0))


@kernel
def _square_rows(
    start: int,
    stop: int,
    values: Floats,
    labels: Labels,
    normal: Floats,
    cell: int,
    half: int,
    least_cosine: float,
    least: float,
    found: Floats,
) -> None:
    """Fill what squares about the pixels of rows start .. stop tell; NaN with fewer than `least` pixels.

    `values` (rows, columns, 12) are position, displacement and its covariance, `normal` those of cells of
    `cell` pixels. `found` (stop - start, columns, 20) has the slopes of position and displacement along rows,
    then along columns, then the spread of the pixels about the middles of their rows, and of their columns,
    and the mean covariance.
    """
    rows, columns = labels.shape
    v, kv, total, slope = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    for row in range(start, stop):
        for column in range(columns):
            out = found[row - start, column]
            out[:] = np.nan
            label = labels[row, column]
            if label == 0:
                continue
            y, x = row // cell, column // cell
            n0, n1, n2 = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
            known = n0 != 0.0 or n1 != 0.0 or n2 != 0.0
            count = 0.0
            total[:] = 0.0
            for axis in range(2):
                down, right = axis, 1 - axis
                spread = 0.0
                slope[:] = 0.0
                for line in range(-half, half + 1):
                    n, sum_k, sum_kk = 0.0, 0.0, 0.0
                    v[:] = 0.0
                    kv[:] = 0.0
                    for k in range(-half, half + 1):
                        r, c = row + line * right + k * down, column + line * down + k * right
                        if not (0 <= r < rows and 0 <= c < columns and labels[r, c] == label):
                            continue
                        a, b, d = (
                            normal[r // cell, c // cell, 0],
                            normal[r // cell, c // cell, 1],
                            normal[r // cell, c // cell, 2],
                        )
                        both = known and (a != 0.0 or b != 0.0 or d != 0.0)
                        if both and a * n0 + b * n1 + d * n2 < least_cosine:
                            continue
                        n += 1.0
                        sum_k += k
                        sum_kk += k * k
                        for i in range(6):
                            one = values[r, c, i] - values[row, column, i]
                            v[i] += one
                            kv[i] += k * one
                        if axis == 0:
                            for i in range(6):
                                total[i] += values[r, c, 6 + i]
                    if axis == 0:
                        count += n
                    if n > 1.0:
                        spread += sum_kk - sum_k * sum_k / n
                        for i in range(6):
                            slope[i] += kv[i] - sum_k * v[i] / n
                if not (spread > 0.0 and count >= least):
                    break
                for i in range(6):
                    out[6 * axis + i] = slope[i] / spread
                out[12 + axis] = spread
            for i in range(6):
                out[14 + i] = total[i] / count


def _in_tangent_plane(
    found: Floats, match: NDArray[np.float32], x_axis: Floats, green_lagrange: bool
) -> tuple[Floats, Floats, Floats]:
    """Return strains (3, ..) and their variances by the pixels' own covariance and by that of the match.

    `match` is (6, ..), `found` (20, ..) is of `_square_rows`. The plane is that of both slopes of
    position.
    """
    place = found[[[0, 1, 2], [6, 7, 8]]]
    moved = found[[[3, 4, 5], [9, 10, 11]]]
    normal = np.cross(place[1], place[0], axis=0)
    size = np.sqrt(np.sum(normal**2, axis=0))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.where(size > _SKEW * np.sqrt(np.prod(np.sum(place**2, axis=1), axis=0)), size, np.nan)
        across = x_axis[:, None, None] - normal * np.tensordot(x_axis, normal, axes=1)
        length = np.sqrt(np.sum(across**2, axis=0))
        e_x = across / np.where(length > 1e-3, length, np.nan)
        axes = np.stack([e_x, np.cross(normal, e_x, axis=0)])
        # Rows and columns in terms of x and y: place[m] = step[m, a] axes[a], and so with what has moved.
        step = np.einsum("mi...,ai...->ma...", place, axes)
        determinant = step[0, 0] * step[1, 1] - step[0, 1] * step[1, 0]
        turn = np.array([[step[1, 1], -step[0, 1]], [-step[1, 0], step[0, 0]]]) / determinant
    slopes = np.einsum("am...,mi...->ai...", turn, moved)
    strain = np.einsum("ai...,bi...->ab...", axes, slopes)
    strain = 0.5 * (strain + strain.swapaxes(0, 1))
    stretched = axes
    if green_lagrange:
        strain += 0.5 * np.einsum("ai...,bi...->ab...", slopes, slopes)
        stretched = axes + slopes
    inverse = np.einsum("am...,bm...,m...->ab...", turn, turn, 1.0 / found[_SPREAD : _SPREAD + 2])

    def variance(packed: NDArray[np.floating]) -> Floats:
        full = packed[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        noise = np.einsum("ai...,ij...,bj...->ab...", stretched, full, stretched)
        shear = inverse[1, 1] * noise[0, 0] + inverse[0, 0] * noise[1, 1] + 2.0 * inverse[0, 1] * noise[0, 1]
        return np.stack([inverse[0, 0] * noise[0, 0], inverse[1, 1] * noise[1, 1], 0.25 * shear])

    return (
        np.stack([strain[0, 0], strain[1, 1], strain[0, 1]]),
        variance(found[_COVARIANCE:]),
        variance(match),
    )


def strain_over_squares(
    xyz: Floats,
    displacement: Floats,
    errors_of: Callable[[int], SharedErrors],
    labels: Labels,
    *,
    side: int,
    x_axis: tuple[float, float, float] = (1.0, 0.0, 0.0),
    green_lagrange: bool = True,
    fold_angle_rad: float = np.pi,
    threads: int = 1,
) -> SurfaceStrain:
    """Return the in-plane strain at every pixel that has a displacement, over squares of pixels about it.

    Parameters
    ----------
    xyz
        (3, rows, columns), positions at the reference state, in any unit of length.
    displacement
        (3, rows, columns) in that unit; NaN where there is none.
    errors_of
        What is known of its errors, as squares of a side in px see them.
    labels
        (rows, columns), continuous regions; a square holds points of its centre's region only.
    side
        N_s, of the square, in px; odd.
    x_axis, green_lagrange, fold_angle_rad, threads
        As of `surface_strain`.

    Notes
    -----
    Thesis section 6.2.5 with Eq. (5.2): the derivative along rows is the mean over a square's rows of the
    slopes of lines by least squares, and so along columns. Rows that lack pixels count by the spread of those
    that they have, and a square with less than half of its pixels gives no strain. As slopes along rows and
    columns are the same sums of displacement and of position, no rigid motion makes Green-Lagrange strain;
    small strain, which is the thesis's, is off by up to half the square of a rotation.

    Bends within a square are told by `gauge_bias` for the disc about it, which makes them rather too large.
    What edges add to noise is that of the disc in which points scatter as in the square.
    """
    used = np.where(np.isfinite(displacement).all(axis=0), labels, 0).astype(np.int32)
    axis, least_cosine = np.asarray(x_axis, dtype=np.float64), float(np.cos(fold_angle_rad))
    errors = errors_of(side)
    cells = cell_means(xyz, displacement, errors.own, used, max(1, side // _CELLS))
    edges = edges_of(labels, cells, axis, errors)

    def fitted(own: SharedErrors, side: int, step: int) -> tuple[Floats, Floats]:
        """Return strain over squares of a side and its variance by noise, of every `step`-th pixel."""
        found = _strained(
            xyz, displacement, own, used, cells, side, axis, green_lagrange, least_cosine, threads
        )
        strain, by_own, by_match = (
            np.ascontiguousarray(each[:, step // 2 :: step, step // 2 :: step]) for each in found
        )
        return strain, noise_at_edges(by_own, by_match, edges.sampled(step), own, 1.0, threads)

    strain, variance = fitted(errors, side, 1)
    radius = side / np.sqrt(2.0)
    middle, least = (pixel_pitch(xyz, used, quantile) for quantile in (0.5, 0.01))
    reach = radius * middle / least
    step = max(1, int(np.ceil(reach / STEPS_TO_A_RADIUS)))
    shorter = []
    for part in SHORTER:
        short = max(3, 2 * int(part * side / 2.0) + 1)
        shorter.append(fitted(errors_of(short), short, step))
    first = step // 2
    at = (..., np.s_[first::step], np.s_[first::step])
    row, column = (np.arange(first, size, step) // cells.side for size in labels.shape)
    samples = Samples(
        step,
        first,
        np.ascontiguousarray(xyz[at]),
        np.ascontiguousarray(cells.normal[:, row[:, None], column]),
        np.ascontiguousarray(used[at]),
        np.ascontiguousarray(strain[at]),
        np.ascontiguousarray(variance[at]),
        tuple(shorter),
    )
    steps = int(np.ceil(reach / step))
    of_gauge = gauge_bias(
        samples, radius * middle, steps, least_cosine, threads, part_by_noise=_PART_BY_NOISE
    )
    square = spread_over_pixels(of_gauge, samples, used, threads)
    square[np.isnan(variance)] = np.nan
    return SurfaceStrain(
        strain, np.sqrt(variance + square), np.sqrt(square), *principal_and_equivalent(strain)
    )


def _strained(
    xyz: Floats,
    displacement: Floats,
    errors: SharedErrors,
    labels: Labels,
    cells: Cells,
    side: int,
    x_axis: Floats,
    green_lagrange: bool,
    least_cosine: float,
    threads: int,
) -> tuple[Floats, Floats, Floats]:
    """Return strains and their variances by own covariances and by the match, each (3, rows, columns)."""
    values = np.ascontiguousarray(np.moveaxis(np.concatenate([xyz, displacement, errors.own]), 0, -1))
    normal = np.ascontiguousarray(np.moveaxis(cells.normal, 0, -1))
    strain, own, match = (np.empty((3, *labels.shape)) for _ in range(3))
    least = LEAST_PART * side**2

    def work(start: int, stop: int) -> None:
        found = np.empty((stop - start, labels.shape[1], _FOUND))
        _square_rows(start, stop, values, labels, normal, cells.side, side // 2, least_cosine, least, found)
        strain[:, start:stop], own[:, start:stop], match[:, start:stop] = _in_tangent_plane(
            np.ascontiguousarray(np.moveaxis(found, -1, 0)),
            errors.match[:, start:stop],
            x_axis,
            green_lagrange,
        )

    in_row_blocks(work, labels.shape[0], threads)
    return strain, own, match
