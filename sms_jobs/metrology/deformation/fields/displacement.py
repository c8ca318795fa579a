"""Dense displacement: image displacement at every pixel, then the shift of its point in space.

Thesis section 4.4. The end point of a pixel is looked up in the deformed state's cloud inside one region
only, and the reference state's point is taken from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks
from sms_jobs.metrology.deformation.fields.averaging import OUTLIER, average_in_region
from sms_jobs.metrology.deformation.fields.blending import blend_rows
from sms_jobs.metrology.deformation.fields.border_noise import beside_borders, bias_by_scatter
from sms_jobs.metrology.deformation.fields.common_noise import CommonNoise, take_common_noise
from sms_jobs.metrology.deformation.matching.shape_functions import WARP
from sms_jobs.metrology.deformation.matching.window_maps import means
from sms_jobs.metrology.geometry.planes import in_space, pixels_as_plane
from sms_jobs.metrology.images.interpolation import interpolate_in_region
from sms_jobs.metrology.images.masks import beside_another_label, box_of

T = TypeVar("T", bound=np.floating[Any])

OUTSIDE_REGION, NO_MATCH_NEAR, LEFT_IMAGE, NO_SHAPE_AT_END = range(1, 5)
"""Why a pixel has no displacement; 0 where it has one."""

_ALONG = 8
"""Radii of a subset about a pixel, over whose squares what matches differ by beyond noise is averaged."""
_OF_MEANS = 0.9
"""Three times by how much of itself such a mean scatters by noise: eight places or so, three numbers each."""
_CHANCE = 5.0
"""By trial at borders: the most that noise makes matches scatter, in variances of blends far from borders."""
_BLEND = {6: (1.633, 1.39), WARP: (1.48, 0.81)}
"""By the numbers of a warp: the distance over which matches are blended, in subset radii, and the variance of
blended matches over that of one (by quadrature): see `blend_matches`."""


@dataclass(frozen=True)
class ImagePoints:
    """Matched points: `x`, `y` (n,) in px, `region` (n,), and their displacement.

    Attributes
    ----------
    warp
        (n, 6): u, du/dx, du/dy, v, dv/dx, dv/dy, in px; or (n, 12), with the second derivatives.
    sigma
        (n, 2), standard deviations of u and v, in px.
    noise_part
        (n,), part of these variances that is the images' noise, the rest being what a subset cannot follow;
        None for all.
    """

    x: Ints
    y: Ints
    region: NDArray[np.int32]
    warp: Floats
    sigma: Floats
    noise_part: Floats | None = None


@dataclass(frozen=True)
class Blended:
    """Matches spread to every pixel of their regions, NaN where no match of the region is within reach.

    Attributes
    ----------
    value, variance
        (2, rows, columns): u and v in px, and their variances in px^2 as the matches state them.
    noise
        (2, rows, columns), in px^2: what of the variances is the images' noise.
    bias
        (2, rows, columns), in px^2: what bends add that all matches see from one side.
    """

    value: Floats
    variance: Floats
    noise: Floats
    bias: Floats


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
    own_noise
        (2, rows, columns) in mm: how far the noise of the camera's own image moves points, see `CommonNoise`;
        None where it does not.
    """

    position: Floats
    covariance: NDArray[np.floating]
    labels: NDArray[np.int32]
    independent: NDArray[np.floating] | None = None
    own_noise: NDArray[np.floating] | None = None

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
    covariance: Singles
    image_displacement: Floats
    bias: Singles
    status: NDArray[np.int32]


def pixel_pitch(xyz: Floats, labels: NDArray[np.int32], quantile: float) -> float:
    """Return a quantile of the distances in mm between neighbouring points of a region; 1 without any."""
    part = box_of(labels > 0)
    xyz, labels = xyz[:, *part], labels[part]
    squares = []
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        step = xyz[:, *first] - xyz[:, *second]
        together = (labels[first] == labels[second]) & (labels[first] > 0)
        squares.append(np.einsum("kij,kij->ij", step, step)[together])
    every = np.sqrt(np.concatenate(squares))
    return float(np.quantile(every, quantile)) if len(every) else 1.0


def blending_reach(subset_radius: int, numbers: int) -> float:
    """Return the distance in px over which matches are blended whose warps have 6 or 12 numbers."""
    return _BLEND[numbers][0] * subset_radius


def blending_factor(numbers: int) -> float:
    """Return the variance of blended matches over that of one, of warps that have 6 or 12 numbers."""
    return _BLEND[numbers][1]


def blend_matches(
    points: ImagePoints, xyz: Floats | None, labels: NDArray[np.int32], subset_radius: int, threads: int = 1
) -> Blended:
    """Spread the image displacement from matched points to every pixel of their regions.

    Parameters
    ----------
    points
        Matches to trust.
    xyz
        (3, rows, columns) in mm, positions at the reference state; None where distances in the image are all
        that counts.
    labels
        (rows, columns), regions of the reference state.
    subset_radius
        Of the matches, in px.
    threads
        How many threads to use.

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
    Beside borders it is 0.75 to 1.4 times as much, and up to 2.4 times: see `beside_borders`.

    Where all matches lie to one side, nothing cancels. By how much they differ about the pixel, beyond what
    noise makes them differ, tells how far the displacement bends, and `bias_by_scatter` what that does.
    """
    rows, columns = labels.shape
    numbers = points.warp.shape[1]
    reach = blending_reach(subset_radius, numbers)
    factor = blending_factor(numbers)
    side = max(1, int(reach / 4))
    shape = (-(-rows // side), -(-columns // side))
    cell = (points.y // side) * (shape[1] + 1) + points.x // side
    order = np.argsort(cell, kind="stable")
    edges = np.arange(shape[0] * (shape[1] + 1))
    first = np.searchsorted(cell[order], edges).reshape(shape[0], shape[1] + 1)
    value = np.empty((2, rows, columns))
    variance, scatter = np.empty((2, rows, columns)), np.empty((2, rows, columns))
    images_part, aside = np.empty((rows, columns)), np.empty((rows, columns))
    footprint = 1.0 if xyz is None else pixel_pitch(xyz, labels, 0.5)
    xyz = in_space(pixels_as_plane(labels.shape)) if xyz is None else xyz
    x, y = points.x[order], points.y[order]
    own_variance = (np.maximum(points.sigma[order], 1e-6) ** 2).T
    warp = np.zeros((WARP, len(order)))
    warp[: points.warp.shape[1]] = points.warp[order].T
    at = xyz[:, y, x]
    whole = own_variance.sum(axis=0)
    of_images = whole if points.noise_part is None else points.noise_part[order] * whole
    matches = np.column_stack([x, y, *at, 1.0 / whole, points.region[order], *own_variance, *warp, of_images])

    def work(start: int, stop: int) -> None:
        blend_rows(
            start, stop, xyz, labels, footprint, side, first, matches, reach,
            value, variance, scatter, images_part, aside,
        )  # fmt: skip

    in_row_blocks(work, rows, threads)
    blend = _BLEND[numbers][0], 6 if numbers == WARP else 3
    factors, by_noise = beside_borders(labels, subset_radius, *blend)
    ratio = bias_by_scatter(aside, *blend)
    beside = ratio > 0.0
    bias = np.zeros((2, rows, columns))
    for found, square, own in zip(bias, scatter, variance, strict=True):
        own, most = own[beside], _CHANCE * factor * own[beside]
        beyond = _beyond_noise(square[beside], by_noise[beside] * own, most, aside, beside, subset_radius)
        found[beside] = ratio[beside] * beyond
    variance *= factor * factors
    return Blended(value, variance, images_part * variance, bias)


def _beyond_noise(
    square: Floats, by_noise: Floats, most: Floats, aside: Floats, beside: Mask, radius: int
) -> Floats:
    """Return of what matches differ by, squared, at pixels (n,) `beside` borders what noise does not make.

    Noise makes so much in the mean, and at most, and scatters: what is more is a mean over squares along the
    border, as much of it as chance does not make and of no pixel more than the most; beyond that a pixel
    tells it by itself.
    """
    weight, weighted = np.zeros(beside.shape), np.zeros(beside.shape)
    weight[beside] = aside[beside] ** 2
    weighted[beside] = weight[beside] * np.minimum(square - (1.0 + _OF_MEANS) * by_noise, most)
    usual, total = (means(one, _ALONG * radius)[beside] for one in (weighted, weight))
    return np.maximum(np.maximum(usual / total, square - most), 0.0)


def displacement_field(
    image: Floats,
    variance: Floats,
    bias: Floats,
    reference: StateShape,
    deformed: StateShape,
    interior: Mask,
    averaging_radius: float,
    threads: int = 1,
    common: CommonNoise | None = None,
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
    common
        What the images' noise does to the match, of shapes that have `own_noise` of the same images.

    Notes
    -----
    Thesis section 4.4.1. The noise of shape is independent from pixel to pixel while the match is already
    an average over its subset; averaging the displacement over less than a subset therefore costs no
    resolution. The covariance is that of both positions, averaged, plus that of the match, which is not,
    carried through the deformed surface's slope along the image; what match and shapes have in common of an
    image's noise is taken off it.
    """
    rows, columns = reference.labels.shape
    part = box_of(reference.labels > 0)
    xyz, labels = reference.position[:, *part], np.ascontiguousarray(reference.labels[part])
    image_part, variance, bias = image[:, *part], variance[:, *part], bias[:, *part]
    y, x = np.mgrid[part]
    end_x, end_y = x + image_part[0], y + image_part[1]
    end, _, slope = interpolate_in_region(
        deformed.position, deformed.covariance[:0], deformed.labels, end_x, end_y, threads
    )
    status = np.zeros(labels.shape, dtype=np.int32)
    status[np.isnan(end[0])] = NO_SHAPE_AT_END
    inside = (end_x >= 0) & (end_y >= 0) & (end_x <= columns - 1) & (end_y <= rows - 1)
    status[~inside] = LEFT_IMAGE
    status[np.isnan(image_part[0])] = NO_MATCH_NEAR
    status[labels == 0] = OUTSIDE_REGION
    # Interpolated noise is smaller but shared by neighbours: in an average it counts as the cloud's own.
    row, column = (np.where(inside, np.rint(np.where(inside, e, 0.0)), 0).astype(int) for e in (end_y, end_x))
    total = reference.covariance[:, *part] + deformed.covariance[:, row, column]
    moved, spread = end - xyz, total
    status[(status == 0) & (np.isnan(total[0]) & (averaging_radius == 0.0))] = NO_SHAPE_AT_END
    if averaging_radius > 0.0:
        independent = reference.averaged[:, *part] + deformed.averaged[:, row, column]
        moved, spread = average_in_region(
            moved, total, labels, interior[part] & (status == 0), averaging_radius, threads, independent
        )
    apart = np.sum((end - xyz - moved) ** 2, axis=0)
    # Its own end point lies on another surface, or where two mix.
    stray = apart > OUTLIER**2 * (total[0] + total[3] + total[5])
    status[(status == 0) & (stray | np.isnan(moved[0]))] = NO_SHAPE_AT_END
    # Within two px of another region they may see either, whichever has got them.
    status[(status == 0) & beside_another_label(labels)] = OUTSIDE_REGION
    biased = _carry_variances(variance, bias, slope, spread, threads)
    if common is not None and reference.own_noise is not None and deformed.own_noise is not None:
        own = reference.own_noise[:, *part], deformed.own_noise
        take_common_noise(spread, (xyz, end), labels, slope, own, (end_x, end_y), common.part(part), threads)
    for field in (moved, spread, biased, image_part):
        np.copyto(field, np.nan, where=status != 0)
    everywhere = np.full((rows, columns), OUTSIDE_REGION, dtype=np.int32)
    everywhere[part] = status
    np.copyto(image, np.nan, where=everywhere != 0)
    all_of_it = partial(_in_whole, part=part, shape=(rows, columns))
    covariance, of_bias = (all_of_it(field.astype(np.float32)) for field in (spread, biased))
    return DenseDisplacement(all_of_it(moved), covariance, image, of_bias, everywhere)


def _carry_variances(variance: Floats, bias: Floats, slope: Floats, spread: Floats, threads: int) -> Floats:
    """Add a match's variances to a covariance (6, rows, columns); return that of the bias alone.

    `slope` (3, 2, rows, columns) carries them into space.
    """
    biased = np.empty_like(spread)

    def work(start: int, stop: int) -> None:
        own = np.s_[..., start:stop, :]
        along, of_bias = slope[own], bias[own]
        of_all = variance[own] + of_bias
        for packed, (i, j) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
            both = along[i] * along[j]
            biased[packed][own] = (both * of_bias).sum(axis=0)
            spread[packed][own] += (both * of_all).sum(axis=0)

    # Of few rows all that is needed stays in a core's cache.
    in_row_blocks(work, spread.shape[1], threads, block=16)
    return biased


def _in_whole(field: NDArray[T], part: tuple[slice, slice], shape: tuple[int, int]) -> NDArray[T]:
    """Return a field (.., rows, columns) of a part of an image over the whole of it, NaN beyond."""
    whole, (rows, columns) = np.empty((*field.shape[:-2], *shape), dtype=field.dtype), part
    for beyond in (np.s_[: rows.start], np.s_[rows.stop :]):
        whole[..., beyond, :] = np.nan
    for beyond in (np.s_[: columns.start], np.s_[columns.stop :]):
        whole[..., rows, beyond] = np.nan
    whole[..., *part] = field
    return whole
