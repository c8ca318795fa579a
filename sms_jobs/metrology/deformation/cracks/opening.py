"""By how much a crack has opened and slid: the jump of displacement across the line where regions part."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.deformation.cracks.polylines import evened, way_along, ways
from sms_jobs.metrology.geometry.transforms import unpack

_LINKED = 2.0  # subset radii by which points of one crack are apart at most
_LEAST_LENGTH = 4.0  # of a crack, in subset radii
_REACH = 3.0  # subset radii of surface on either side that the displacement is taken from
_LEAST_PART = 0.15  # of that disc that a side must have
_OF_BENDING = 1 / 3  # a plane's error over the second difference: 1 / 4 of a parabola, more at a tip
_BY_CHANCE = 2.0  # standard deviations of a second difference that say nothing
_LEAST_FREEDOM = 0.5  # degrees that tell by how much a line strays
_BLENDED = 1.39  # variance of blended matches over that of one subset's


@dataclass(frozen=True)
class Field:
    """A displacement over a reference image, and what it is known with.

    Attributes
    ----------
    position, displacement
        (3, rows, columns), in one unit of length; NaN where there is none.
    covariance, bias
        (6, rows, columns), of the displacement, and the part of it that is no noise.
    labels
        (rows, columns), regions, 0 for none.
    subset_radius_px
        Over which the errors go together.
    """

    position: Floats
    displacement: Floats
    covariance: NDArray[np.floating]
    bias: NDArray[np.floating]
    labels: Labels
    subset_radius_px: int


@dataclass(frozen=True)
class CrackOpening:
    """Points along one crack.

    Attributes
    ----------
    sides
        The regions on the right and on the left of the way along it.
    pixel
        (n, 2), column and row.
    position
        (n, 3), in the unit of the field.
    opening, sigma
        (3, n): how far the left side has gone from the right one across the crack, along it and out of the
        surface, and the standard deviations.
    """

    sides: tuple[int, int]
    pixel: Floats
    position: Floats
    opening: Floats
    sigma: Floats


def crack_openings(field: Field, origin: Mapping[int, int], spacing_px: int) -> Iterator[CrackOpening]:
    """Yield what each crack has opened by.

    Parameters
    ----------
    field
        The displacement.
    origin
        Of every region, the region that it was part of before anything came apart.
    spacing_px
        Distance of points along a crack.

    Notes
    -----
    A crack is where two pieces of one region are nearest to each other. At each point of its line a plane is
    fitted to the displacement of either side within three subset radii, weighted by its inverse variance;
    the jump is the difference of the two at the line. Errors go together over a subset, of bias as of noise.
    What the jump bends by along the crack and the error of the line's direction are counted, too. Where a
    side has less than a seventh of the disc, as where the crack runs into an edge, there is no point.
    """
    radius = max(field.subset_radius_px, 1)
    for (right, left), place in _seams(field.labels, origin, radius):
        for way in ways(place, _LINKED * radius, _LEAST_LENGTH * radius):
            line = _Line.through(place[way], radius, spacing_px)
            if np.median(_side_of(line, field.labels, left, radius)) < 0.0:
                line = line.backwards()
            found = _opening(field, (right, left), line, radius)
            if found is not None:
                yield found


def _seams(
    labels: Labels, origin: Mapping[int, int], radius: int
) -> Iterator[tuple[tuple[int, int], Floats]]:
    """Yield pairs of pieces, and places (n, 2) between them, as row and column, that are nearest to both."""
    distance, (row, column) = ndimage.distance_transform_edt(labels == 0, return_indices=True)
    near = np.where(distance <= 1.5 * radius, labels[row, column], 0)
    family = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    for number, whole in origin.items():
        family[number] = whole
    pairs, places = [], []
    for axis, half in ((0, (0.5, 0.0)), (1, (0.0, 0.5))):
        one, other = (
            np.take(near, range(*span), axis) for span in ((0, near.shape[axis] - 1), (1, near.shape[axis]))
        )
        seam = (one > 0) & (other > 0) & (one != other) & (family[one] == family[other])
        places.append(np.argwhere(seam) + half)
        pairs.append(np.sort(np.stack([one[seam], other[seam]], axis=1), axis=1))
    pair, place = np.concatenate(pairs), np.concatenate(places)
    for both in np.unique(pair, axis=0):
        yield (int(both[0]), int(both[1])), place[(pair == both).all(axis=1)]


@dataclass(frozen=True)
class _Line:
    """Points of a crack: places and unit normals (n, 2) as row and column, and errors (n,) of these in rad.

    The normals point to the left of the way along the line, the image seen with y upwards.
    """

    place: Floats
    normal: Floats
    error: Floats

    @classmethod
    def through(cls, place: Floats, radius: int, spacing: int) -> _Line:
        """Return points that are `spacing` apart on a line through scattered ones (n, 2) in their order.

        A straight line is fitted about each, over three subset radii to either side. What lies within one
        subset goes astray together, so that these are some three independent places, of which the fit itself
        takes two. By how much they stray is taken to be what is usual of the line, or more where it bends.
        """
        way = way_along(place)
        rough, smooth = evened(place, way, 1.0), evened(place, way, 0.5 * radius)
        chosen = np.arange(min(spacing // 2, len(rough) - 1), len(rough), spacing)
        normals, extents, lengths = [], [], []
        for k in chosen:
            near = rough[max(k - 3 * radius, 0) : k + 3 * radius + 1]
            _, extent, axes = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)
            along = axes[0] * (np.sign(axes[0] @ (near[-1] - near[0])) or 1.0)
            normals.append((-along[1], along[0]))
            extents.append(extent**2)
            lengths.append(len(near))
        independent = np.array(lengths) / (2.0 * radius + 1.0)
        along, across = (np.array(extents) / np.array(lengths)[:, None]).T
        stray = across * independent / np.maximum(independent - 2.0, _LEAST_FREEDOM)
        stray = np.maximum(stray, np.median(stray))
        return cls(smooth[chosen], np.array(normals), np.sqrt(stray / (along * independent)))

    def backwards(self) -> _Line:
        """Return it the other way round."""
        return _Line(self.place[::-1], -self.normal[::-1], self.error[::-1])

    def where(self, chosen: Mask) -> _Line:
        return _Line(self.place[chosen], self.normal[chosen], self.error[chosen])


def _side_of(line: _Line, labels: Labels, left: int, radius: int) -> Floats:
    """Return at each point whether a region lies before (1) or behind (-1) the line, 0 for neither."""
    found = np.zeros(len(line.place))
    for sign in (1.0, -1.0):
        row, column = np.rint(line.place + sign * 2.0 * radius * line.normal).astype(int).T
        row, column = np.clip(row, 0, labels.shape[0] - 1), np.clip(column, 0, labels.shape[1] - 1)
        found += sign * (labels[row, column] == left)
    return found


def _opening(field: Field, sides: tuple[int, int], line: _Line, radius: int) -> CrackOpening | None:
    """Return the opening at points of a crack; None where no point has enough on both sides."""
    fits = [[_fitted(field, number, place, _REACH * radius) for number in sides] for place in line.place]
    known = np.array([all(pair) for pair in fits], dtype=bool)
    both = [(a, b) for a, b in fits if a and b]
    if not both:
        return None
    line = line.where(known)
    normal = line.normal
    position, right, down = np.mean([(a.plane, b.plane) for a, b in both], axis=1).swapaxes(0, 1)
    along = _unit(down * normal[:, 1:] - right * normal[:, :1])
    across = right * normal[:, 1:] + down * normal[:, :1]
    across = _unit(across - np.sum(across * along, axis=1, keepdims=True) * along)
    axes = np.stack([across, along, -_unit(np.cross(right, down))])
    jump = np.array([b.value - a.value for a, b in both])
    covariance = np.array([a.covariance + b.covariance for a, b in both])
    way = way_along(line.place)
    covariance += _bending(jump, covariance, way, _REACH * radius)
    opening = np.einsum("anj,nj->an", axes, jump)
    variance = np.einsum("ani,nij,anj->an", axes, covariance, axes)
    # A line that is askew takes of one for the other.
    variance[:2] += (line.error * opening[1::-1]) ** 2
    return CrackOpening(sides, line.place[:, ::-1], position, opening, np.sqrt(variance))


def _bending(jump: Floats, covariance: Floats, way: Floats, reach: float) -> Floats:
    """Return the covariance (n, 3, 3) of what planes make of a jump (n, 3) that bends along the crack.

    Its second difference over the reach of the planes is taken, as far as it is no chance, and the largest
    about each point: as at a tip, ahead of which planes see an opening that is behind it.
    """
    ahead, behind = (
        np.stack([np.interp(way + step, way, one) for one in jump.T], axis=1) for step in (reach, -reach)
    )
    second = ahead + behind - 2.0 * jump
    chance = 6.0 * np.einsum("nii->ni", covariance)
    sure = np.sqrt(np.maximum(second**2 - _BY_CHANCE**2 * chance, 0.0))
    near = np.abs(way[:, None] - way) <= reach
    most = np.max(np.where(near[:, :, None], sure, 0.0), axis=1)
    return np.asarray(_OF_BENDING**2 * most[:, :, None] * np.eye(3) * most[:, None, :])


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@dataclass(frozen=True)
class _Fit:
    """Planes through displacement and position: the displacement at the line, its covariance, the surface."""

    value: Floats
    covariance: Floats
    plane: Floats


def _fitted(field: Field, number: int, place: Floats, reach: float) -> _Fit | None:
    """Fit planes to what one side has within reach of a place; None for too little."""
    low = np.maximum(np.ceil(place - reach).astype(int), 0)
    high = np.floor(place + reach).astype(int) + 1
    box = np.s_[low[0] : high[0], low[1] : high[1]]
    labels = field.labels[box]
    row, column = np.mgrid[low[0] : low[0] + labels.shape[0], low[1] : low[1] + labels.shape[1]]
    down, right = row - place[0], column - place[1]
    used = (labels == number) & (down**2 + right**2 <= reach**2)
    used &= np.isfinite(field.displacement[:, *box]).all(axis=0)
    if np.count_nonzero(used) < _LEAST_PART * np.pi * reach**2:
        return None
    basis = np.stack([np.ones(np.count_nonzero(used)), right[used], down[used]], axis=1)
    moved, where = (values[:, *box][:, used].T for values in (field.displacement, field.position))
    total, bias = (values[:, *box][:, used].astype(np.float64) for values in (field.covariance, field.bias))
    weight = 1.0 / np.maximum(total[0] + total[3] + total[5], 1e-30)
    projector = np.linalg.solve((basis * weight[:, None]).T @ basis, (basis * weight[:, None]).T)
    subset = (2.0 * field.subset_radius_px + 1.0) ** 2
    share = projector[0] ** 2 @ ((total - bias) / _BLENDED + bias).T * subset
    return _Fit(projector[0] @ moved, unpack(share), projector @ where)
