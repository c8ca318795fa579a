"""By how much a crack has opened and slid: the jump of displacement across the line where regions part."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from sms_jobs.metrology.arrays import Floats, Ints, Labels, Mask
from sms_jobs.metrology.deformation.cracks.curves import course, estimated, walk
from sms_jobs.metrology.deformation.cracks.polylines import way_along, ways
from sms_jobs.metrology.geometry.transforms import unpack

_LINKED = 2.0  # subset radii by which points of one crack are apart at most
_LEAST_LENGTH = 4.0  # of a crack, in subset radii
_DEPTH = 3.0  # subset radii of surface on either side that the displacement is taken from
_LEAST_PART = 0.5  # of such a strip that a side must have
_LEAST_STRIPS = 4  # of a crack
_LEAST_VARIANCE = 1e-30
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
    A crack is where two pieces of one region are nearest to each other, and goes where its places tell. In
    strips of one subset radius along it and three across, planes are fitted to the displacement of either
    side, weighted by its inverse variance; the jump is the difference of the two at the line. What strips
    have found across, along and out of the surface is a walk each (`curves`), whose roughness they tell: an
    opening that is even is told by all of them, and about a tip each tells its own. Errors go together over a
    subset, of bias as of noise. The error of the line's direction is counted, too. Where a side has less than
    half of a strip, as where the crack runs into an edge, there is no point.
    """
    radius = max(field.subset_radius_px, 1)
    for (right, left), place in _seams(field.labels, origin, radius):
        for way in ways(place, _LINKED * radius, _LEAST_LENGTH * radius):
            line = _Line.through(place[way], radius)
            if np.median(_side_of(line, field.labels, left, radius)) < 0.0:
                line = line.backwards()
            found = _opening(field, (right, left), line, spacing_px)
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
    """Points of a crack: how far along it they are, places and unit normals (n, 2) as row and column.

    The normals point to the left of the way along the line, the image seen with y upwards; `error` (n,) is
    theirs, in rad.
    """

    way: Floats
    place: Floats
    normal: Floats
    error: Floats

    @classmethod
    def through(cls, place: Floats, radius: int) -> _Line:
        """Return points some subset radius apart on a line through scattered ones (n, 2) in their order."""
        count = max(round(way_along(place)[-1] / radius), _LEAST_STRIPS)
        found = course(place, (np.arange(count) + 0.5) / count, radius)
        normal = np.stack([-found.ahead[:, 1], found.ahead[:, 0]], axis=1)
        return cls(found.way, found.place, normal, found.error)

    def backwards(self) -> _Line:
        """Return it the other way round."""
        return _Line(
            self.way[-1] - self.way[::-1] + self.way[0],
            self.place[::-1],
            -self.normal[::-1],
            self.error[::-1],
        )

    def where(self, chosen: Mask) -> _Line:
        return _Line(self.way[chosen], self.place[chosen], self.normal[chosen], self.error[chosen])

    def at(self, way: Floats) -> _Line:
        """Return the line at other points."""

        def between(values: Floats) -> Floats:
            return np.stack([np.interp(way, self.way, column) for column in values.T], axis=1)

        return _Line(
            way, between(self.place), _unit(between(self.normal)), np.interp(way, self.way, self.error)
        )


def _side_of(line: _Line, labels: Labels, left: int, radius: int) -> Floats:
    """Return at each point whether a region lies before (1) or behind (-1) the line, 0 for neither."""
    found = np.zeros(len(line.place))
    for sign in (1.0, -1.0):
        row, column = np.rint(line.place + sign * 2.0 * radius * line.normal).astype(int).T
        row, column = np.clip(row, 0, labels.shape[0] - 1), np.clip(column, 0, labels.shape[1] - 1)
        found += sign * (labels[row, column] == left)
    return found


def _opening(field: Field, sides: tuple[int, int], line: _Line, spacing_px: int) -> CrackOpening | None:
    """Return the opening at points of a crack; None where too few strips have enough on both sides."""
    radius = max(field.subset_radius_px, 1)
    fits = [
        [_fitted(field, number, place, normal, radius) for number in sides]
        for place, normal in zip(line.place, line.normal, strict=True)
    ]
    both = [(a, b) for a, b in fits if a and b]
    if len(both) < _LEAST_STRIPS:
        return None
    line = line.where(np.array([all(pair) for pair in fits], dtype=bool))
    normal = line.normal
    position, right, down = np.mean([(a.plane, b.plane) for a, b in both], axis=1).swapaxes(0, 1)
    along = _unit(down * normal[:, 1:] - right * normal[:, :1])
    across = right * normal[:, 1:] + down * normal[:, :1]
    across = _unit(across - np.sum(across * along, axis=1, keepdims=True) * along)
    axes = np.stack([across, along, -_unit(np.cross(right, down))])
    jump = np.einsum("anj,nj->an", axes, [b.value - a.value for a, b in both])
    way = _points(line.way, spacing_px, radius)
    if not len(way):
        return None
    opening, variance = np.empty((3, len(way))), np.empty((3, len(way)))
    for k, axis in enumerate(axes):
        behind, before = (_noise([pair[side] for pair in both], axis, field, radius) for side in (0, 1))
        found, variance[k] = estimated(walk(line.way, way, float(radius)), jump[k][:, None], behind + before)
        opening[k] = found[:, 0]
    at = line.at(way)
    # A line that is askew takes of one for the other.
    variance[:2] += (at.error * opening[1::-1]) ** 2
    place = np.stack([np.interp(way, line.way, column) for column in position.T], axis=1)
    return CrackOpening(sides, at.place[:, ::-1], place, opening, np.sqrt(variance))


def _points(way: Floats, spacing_px: int, radius: int) -> Floats:
    """Return points along a crack that are `spacing_px` apart and not far from its strips at `way` (n,)."""
    at = np.arange(way[0] + 0.5 * ((way[-1] - way[0]) % spacing_px), way[-1] + 1e-6, spacing_px)
    nearest = np.min(np.abs(at[:, None] - way), axis=1)
    return np.asarray(at[nearest <= radius])


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@dataclass(frozen=True)
class _Fit:
    """Planes through displacement and position: the displacement at the line, the surface, and the weights.

    Attributes
    ----------
    value, plane
        (3,) and (3, 3): the displacement, and the position with its slopes to the right and down.
    row, column, weight
        (n,), the pixels that the displacement is a sum over.
    """

    value: Floats
    plane: Floats
    row: Ints
    column: Ints
    weight: Floats


def _fitted(field: Field, number: int, place: Floats, normal: Floats, radius: int) -> _Fit | None:
    """Fit planes to what one side has in a strip across the line; None for too little."""
    depth, half = _DEPTH * radius, 0.5 * radius
    reach = np.hypot(depth, half)
    low = np.maximum(np.ceil(place - reach).astype(int), 0)
    high = np.floor(place + reach).astype(int) + 1
    box = np.s_[low[0] : high[0], low[1] : high[1]]
    labels = field.labels[box]
    row, column = np.mgrid[low[0] : low[0] + labels.shape[0], low[1] : low[1] + labels.shape[1]]
    down, right = row - place[0], column - place[1]
    used = (labels == number) & (np.abs(down * normal[0] + right * normal[1]) <= depth)
    used &= np.abs(down * normal[1] - right * normal[0]) <= half
    used &= np.isfinite(field.displacement[:, *box]).all(axis=0)
    if np.count_nonzero(used) < _LEAST_PART * 2.0 * half * depth:
        return None
    basis = np.stack([np.ones(np.count_nonzero(used)), right[used], down[used]], axis=1)
    moved, where = (values[:, *box][:, used].T for values in (field.displacement, field.position))
    total = field.covariance[:, *box][:, used].astype(np.float64)
    weight = 1.0 / np.maximum(total[0] + total[3] + total[5], _LEAST_VARIANCE)
    projector = np.linalg.solve((basis * weight[:, None]).T @ basis, (basis * weight[:, None]).T)
    return _Fit(projector[0] @ moved, projector @ where, row[used], column[used], projector[0])


def _noise(fits: list[_Fit], axis: Floats, field: Field, radius: int) -> Floats:
    """Return the covariance (n, n) of what strips have along an axis (n, 3) each.

    Errors of pixels go together as subsets overlap: a square filter's products. Blending makes these smaller:
    it adds to the variance, and not to that of a mean.
    """
    half = round(radius / np.sqrt(_BLENDED))
    side = 2 * half + 1
    kept = (2.0 * radius + 1.0) ** 2 / side**2
    rows, columns = field.labels.shape[0] + 2 * half, field.labels.shape[1] + 2 * half
    values, places = [], []
    for fit, along in zip(fits, axis, strict=True):
        total, bias = (
            np.einsum("i,nij,j->n", along, unpack(one[:, fit.row, fit.column].astype(np.float64)), along)
            for one in (field.covariance, field.bias)
        )
        sigma = np.sqrt(np.maximum(((total - bias) / _BLENDED + bias) * kept, _LEAST_VARIANCE))
        top, left = fit.row.min() - half, fit.column.min() - half
        patch = np.zeros((fit.row.max() + half + 1 - top, fit.column.max() + half + 1 - left))
        patch[fit.row - top, fit.column - left] = fit.weight * sigma
        patch = ndimage.uniform_filter(patch, side, mode="constant") * side
        row, column = np.mgrid[top : top + patch.shape[0], left : left + patch.shape[1]] + half
        values.append(patch.ravel())
        places.append((row * columns + column).ravel())
    ends = np.cumsum([0, *(len(one) for one in values)])
    spread = sparse.csr_array(
        (np.concatenate(values), np.concatenate(places), ends), shape=(len(fits), rows * columns)
    )
    return np.asarray((spread @ spread.T).toarray())
