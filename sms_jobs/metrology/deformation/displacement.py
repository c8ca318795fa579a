"""Dense displacement: image displacement at every pixel, then the shift of its point in space.

Thesis section 4.4. The end point of a pixel is looked up in the deformed state's cloud inside one region
only, and the reference state's point is taken from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.deformation.averaging import OUTLIER, average_in_region
from sms_jobs.metrology.deformation.shape_functions import WARP
from sms_jobs.metrology.images.interpolation import interpolate_in_region

Floats: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = NDArray[np.int32]
Ints: TypeAlias = NDArray[np.int64]

OUTSIDE_REGION, NO_MATCH_NEAR, LEFT_IMAGE, NO_SHAPE_AT_END = range(1, 5)
"""Why a pixel has no displacement; 0 where it has one."""

_BLEND = {6: (1.633, 1.39), WARP: (1.48, 0.81)}
"""By the numbers of a warp: the distance over which matches are blended, in subset radii, and the variance of
blended matches over that of one (by quadrature): see `blend_matches`."""


_HALF_DISC = 0.29
"""Mean distance of the matches about a pixel from it, in radii of blending, if they fill half a disc."""
_CARRIED, _CHANCE = 0.25, 5.0
"""By trial at borders: the part of such matches' scatter that noise alone makes an error, and that scatter in
variances of the blend."""


@dataclass(frozen=True)
class ImagePoints:
    """Matched points: `x`, `y` (n,) in px, `region` (n,), and their displacement.

    Attributes
    ----------
    warp
        (n, 6): u, du/dx, du/dy, v, dv/dx, dv/dy, in px; or (n, 12), with the second derivatives.
    sigma
        (n, 2), standard deviations of u and v, in px.
    """

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    region: NDArray[np.int32]
    warp: Floats
    sigma: Floats


@dataclass(frozen=True)
class StateShape:
    """Where the surface of a state lies.

    Attributes
    ----------
    position
        (3, rows, columns) in mm.
    covariance
        (6, rows, columns) in mm^2, of each pixel by itself.
    labels
        (rows, columns), regions; 0 for none.
    independent
        (6, rows, columns) in mm^2: what of the covariance a mean over pixels makes less; None for all.
    """

    position: Floats
    covariance: NDArray[np.floating]
    labels: NDArray[np.int32]
    independent: NDArray[np.floating] | None = None

    @property
    def averaged(self) -> NDArray[np.floating]:
        """What goes into the covariance of a mean, (6, rows, columns) in mm^2."""
        return self.covariance if self.independent is None else self.independent


@dataclass(frozen=True)
class DenseDisplacement:
    """A displacement at every pixel.

    Attributes
    ----------
    displacement
        (3, rows, columns) in mm.
    covariance
        (6, rows, columns) in mm^2, packed XX, XY, XZ, YY, YZ, ZZ.
    image_displacement
        (2, rows, columns): u and v in px.
    bias
        (6, rows, columns) in mm^2: the part of the covariance that comes of the bias of the match.
    status
        (rows, columns): 0 or why there is no value; then all of the above are NaN.
    """

    displacement: Floats
    covariance: Floats
    image_displacement: Floats
    bias: Floats
    status: NDArray[np.int32]


@kernel
def _blend_rows(
    start: int, stop: int, xyz: Floats, labels: Labels, footprint: float, side: int, first: Ints,
    px: Ints, py: Ints, region: Labels, at: Floats, warp: Floats, own_variance: Floats,
    reach: float, noise: float, value: Floats, variance: Floats,
) -> None:  # fmt: skip
    """Do the work of `blend_matches` for rows start .. stop.

    Matches are sorted into square cells of `side`: those of cells (j, i) to (j, m) are `first[j, i]` up to
    `first[j, m + 1]`. `at` (n, 3) is where they lie in space, `own_variance` (n, 2) that of their u and v.
    """
    cells = int(np.ceil(reach / side))
    bent = warp.shape[1] > 6
    for r in range(start, stop):
        for c in range(labels.shape[1]):
            value[0, r, c] = value[1, r, c] = variance[0, r, c] = variance[1, r, c] = np.nan
            if labels[r, c] == 0:
                continue
            total, off_x, off_y, u_sum, v_sum = 0.0, 0.0, 0.0, 0.0, 0.0
            u_squares, v_squares, u_noise, v_noise = 0.0, 0.0, 0.0, 0.0
            row = r // side
            column = c // side
            left, right = max(column - cells, 0), min(column + cells + 1, first.shape[1] - 1)
            for j in range(max(row - cells, 0), min(row + cells + 1, first.shape[0])):
                for m in range(first[j, left], first[j, right]):
                    dx = c - px[m]
                    dy = r - py[m]
                    d2 = dx * dx + dy * dy
                    if d2 >= 2.0 * reach * reach or region[m] != labels[r, c]:
                        continue
                    apart = 0.0
                    for a in range(3):
                        apart += (xyz[a, r, c] - at[m, a]) ** 2
                    d2 = 0.5 * (d2 + apart / footprint**2) / reach**2
                    if not d2 < 1.0:
                        continue
                    w = (1.0 - d2) ** 2 / (own_variance[m, 0] + own_variance[m, 1])
                    total += w
                    off_x += w * dx
                    off_y += w * dy
                    u = warp[m, 0] + warp[m, 1] * dx + warp[m, 2] * dy
                    v = warp[m, 3] + warp[m, 4] * dx + warp[m, 5] * dy
                    if bent:
                        xx, xy, yy = 0.5 * dx * dx, dx * dy, 0.5 * dy * dy
                        u += warp[m, 6] * xx + warp[m, 7] * xy + warp[m, 8] * yy
                        v += warp[m, 9] * xx + warp[m, 10] * xy + warp[m, 11] * yy
                    u_sum += w * u
                    v_sum += w * v
                    u_squares += w * u * u
                    v_squares += w * v * v
                    u_noise += w * own_variance[m, 0]
                    v_noise += w * own_variance[m, 1]
            if total > 0.0:
                one_sided = (off_x * off_x + off_y * off_y) / (total * reach * _HALF_DISC) ** 2
                for a in range(2):
                    mean = (u_sum if a == 0 else v_sum) / total
                    own = noise * (u_noise if a == 0 else v_noise) / total
                    scatter = max((u_squares if a == 0 else v_squares) / total - mean * mean, 0.0)
                    value[a, r, c] = mean
                    variance[a, r, c] = own + one_sided * max(_CARRIED * scatter, scatter - _CHANCE * own)


def pixel_pitch(xyz: Floats, labels: NDArray[np.int32], quantile: float) -> float:
    """Return a quantile of the distances in mm between neighbouring points of a region; 1 without any."""
    steps = []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        together = (labels[first] == labels[second]) & (labels[first] > 0)
        steps.append(
            np.linalg.norm(xyz[(slice(None), *first)] - xyz[(slice(None), *second)], axis=0)[together]
        )
    every = np.concatenate(steps)
    return float(np.quantile(every, quantile)) if len(every) else 1.0


def blending_reach(subset_radius: int, numbers: int) -> float:
    """Return the distance in px over which matches are blended whose warps have 6 or 12 numbers."""
    return _BLEND[numbers][0] * subset_radius


def blend_matches(
    points: ImagePoints, xyz: Floats, labels: NDArray[np.int32], subset_radius: int, threads: int = 1
) -> tuple[Floats, Floats]:
    """Spread the image displacement from matched points to every pixel of their regions.

    Parameters
    ----------
    points
        Matches to trust.
    xyz
        (3, rows, columns) in mm, positions at the reference state.
    labels
        (rows, columns), regions of the reference state.
    subset_radius
        Of the matches, in px.
    threads
        How many threads to use.

    Returns
    -------
    value, variance
        (2, rows, columns): u and v in px and their variances in px^2; NaN where no match of the pixel's
        region is within reach.

    Notes
    -----
    Thesis Eq. (3.21) with weights from image and 3D distance (and the matches' own variance), but each
    match stands for the plane of its own value and gradient instead of a plane through three values: the
    result is exact for affine displacement up to the region's edge and beyond its outermost match.

    A first-order subset of radius r overestimates a displacement of curvature k by k r^2 / 6; carrying it
    by its gradient over a distance d underestimates by k d^2 / 2. With the weight (1 - d^2 / reach^2)^2
    the mean of d^2 along an axis is reach^2 / 8, so that both cancel at reach = r sqrt(8 / 3). Those of
    second order know the curvature; of them the same holds for the fourth derivatives at 1.48 r.

    Neighbouring subsets share most of their pixels, so blending does not average their noise; with that of
    the gradients it comes to 1.39 times the mean variance, to 0.81 times that of subsets of second order.

    Where all matches lie to one side, nothing cancels: by how much they differ about the pixel, beyond what
    noise makes them differ, is added to the variance, in full where they fill half a disc, less where their
    middle is nearer.
    """
    rows, columns = labels.shape
    noise = _BLEND[points.warp.shape[1]][1]
    reach = blending_reach(subset_radius, points.warp.shape[1])
    side = max(1, int(reach / 4))
    shape = (-(-rows // side), -(-columns // side))
    cell = (points.y // side) * (shape[1] + 1) + points.x // side
    order = np.argsort(cell, kind="stable")
    edges = np.arange(shape[0] * (shape[1] + 1))
    first = np.searchsorted(cell[order], edges).reshape(shape[0], shape[1] + 1)
    value = np.empty((2, rows, columns))
    variance = np.empty((2, rows, columns))
    footprint = pixel_pitch(xyz, labels, 0.5)
    x, y = points.x[order], points.y[order]
    at = np.ascontiguousarray(xyz[:, y, x].T)
    region, warp = points.region[order], np.ascontiguousarray(points.warp[order])
    own_variance = np.maximum(points.sigma[order], 1e-6) ** 2

    def work(start: int, stop: int) -> None:
        _blend_rows(
            start, stop, xyz, labels, footprint, side, first, x, y, region, at, warp, own_variance,
            reach, noise, value, variance,
        )  # fmt: skip

    in_row_blocks(work, rows, threads)
    return value, variance


def _between_regions(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return which pixels are within two of another region: they may see either, whichever has got them."""
    low = ndimage.minimum_filter(np.where(labels > 0, labels, np.iinfo(np.int32).max), 5)
    return np.asarray((labels > 0) & ((low != labels) | (ndimage.maximum_filter(labels, 5) != labels)))


def displacement_field(
    image: Floats,
    variance: Floats,
    bias: Floats,
    reference: StateShape,
    deformed: StateShape,
    interior: NDArray[np.bool_],
    averaging_radius: float,
    threads: int = 1,
) -> DenseDisplacement:
    """Return the displacement of the material point seen by every pixel of the reference image.

    Parameters
    ----------
    image, variance, bias
        (2, rows, columns): u and v in px at each pixel, NaN where there is none (changed in place), their
        variances by noise in px^2, and those that are no noise.
    reference, deformed
        The surface at each state.
    interior
        (rows, columns): pixels of the reference far enough from their region's edge to see nothing else.
    averaging_radius
        Within which the displacement is averaged, in px: see `average_in_region`. 0 where the errors of the
        positions go together over more than that, and an average would gain nothing.
    threads
        How many threads to use; the result does not depend on it.

    Notes
    -----
    Thesis section 4.4.1. The noise of shape is independent from pixel to pixel while the match is already
    an average over its subset; averaging the displacement over less than a subset therefore costs no
    resolution. The covariance is that of both positions, averaged, plus that of the match, which is not,
    carried through the deformed surface's slope along the image.
    """
    xyz, labels = reference.position, reference.labels
    rows, columns = labels.shape
    y, x = np.mgrid[0:rows, 0:columns]
    end_x, end_y = x + image[0], y + image[1]
    end, _, slope = interpolate_in_region(
        deformed.position, deformed.covariance[:0], deformed.labels, end_x, end_y, threads
    )
    status = np.zeros(labels.shape, dtype=np.int32)
    status[np.isnan(end[0])] = NO_SHAPE_AT_END
    inside = (end_x >= 0) & (end_y >= 0) & (end_x <= columns - 1) & (end_y <= rows - 1)
    status[~inside] = LEFT_IMAGE
    status[np.isnan(image[0])] = NO_MATCH_NEAR
    status[labels == 0] = OUTSIDE_REGION
    # Interpolated noise is smaller but shared by neighbours: in an average it counts as the cloud's own.
    row, column = (np.where(inside, np.rint(np.where(inside, e, 0.0)), 0).astype(int) for e in (end_y, end_x))
    total = reference.covariance + deformed.covariance[:, row, column]
    moved, spread = end - xyz, total
    status[(status == 0) & (np.isnan(total[0]) & (averaging_radius == 0.0))] = NO_SHAPE_AT_END
    if averaging_radius > 0.0:
        independent = reference.averaged + deformed.averaged[:, row, column]
        moved, spread = average_in_region(
            moved, total, labels, interior & (status == 0), averaging_radius, threads, independent
        )
    apart = np.sum((end - xyz - moved) ** 2, axis=0)
    # Its own end point lies on another surface, or where two mix.
    stray = apart > OUTLIER**2 * (total[0] + total[3] + total[5])
    status[(status == 0) & (stray | np.isnan(moved[0]))] = NO_SHAPE_AT_END
    status[(status == 0) & _between_regions(labels)] = OUTSIDE_REGION
    biased = np.zeros_like(spread)
    for packed, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        for axis in range(2):
            along = slope[i, axis] * slope[j, axis]
            biased[packed] += along * bias[axis]
            spread[packed] += along * (variance[axis] + bias[axis])
    for field in (moved, spread, biased, image):
        field[:, status != 0] = np.nan
    return DenseDisplacement(moved, spread, image, biased, status)
