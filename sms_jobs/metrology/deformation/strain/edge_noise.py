"""What edges do to the noise of strain: beside one, errors of displacement that go together weigh more.

Beside an edge subsets and averages are cut, and a rim that is not used is bridged by what they say: errors
there have the shape of a slope. How much more of them strain has follows from their filters, by exact
propagation beside a straight edge (`edge_propagation`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.compilation import in_row_blocks, uncounted_kernel
from sms_jobs.metrology.deformation.fields.cells import Cells
from sms_jobs.metrology.deformation.matching.subsets import RIM
from sms_jobs.metrology.deformation.strain.edge_propagation import EdgeFactors, edge_factors
from sms_jobs.metrology.deformation.strain.strain_errors import SharedErrors
from sms_jobs.metrology.images.masks import beside_another_label, distance_inside, wide_gaps

# Of how many px no average uses anything: at the border of the image, and at a region's edge.
_RIMS_OF_SHAPE = (0.0, 1.0)
_PER_PX = 4.0  # distances that are told to a pixel


@dataclass(frozen=True)
class Edges:
    """How far pixels are from the nearest edges, and how these lie to an axis.

    Attributes
    ----------
    distance
        (2, rows, columns), in px from the border of the image, where a region reaches it, and from the edge
        of a region; 0 at the outermost pixel.
    along
        (2, rows, columns), squared cosine of the angle between edge and axis in the surface; 0.5 where it is
        not known.
    """

    distance: Floats
    along: Floats

    def sampled(self, step: int) -> Edges:
        """Return those of every `step`-th pixel, from the half of that on."""
        part = (..., np.s_[step // 2 :: step], np.s_[step // 2 :: step])
        return Edges(np.ascontiguousarray(self.distance[part]), np.ascontiguousarray(self.along[part]))


def edges_of(labels: Labels, cells: Cells, x_axis: Floats, shared: SharedErrors) -> Edges:
    """Return the edges of regions (rows, columns), 0 for none, and how they lie to an axis (3,).

    Gaps that are smaller than a subset's radius are none, and a border beyond a wider one does nothing to
    what is matched. Directions are told as far as edges matter.
    """
    gaps = wide_gaps(labels, max(int(shared.subset_radius_px), 1))
    distance = np.stack([_from_border(gaps), _from_regions(gaps | beside_another_label(labels))])
    reach = shared.disc_radius_px + 4.0 * max(shared.averaging_radius_px, shared.subset_radius_px)
    along = np.full(distance.shape, 0.5)
    for sort in (0, 1):
        near = (distance[sort] < reach) & (labels > 0)
        away = _rising(distance[sort], near)
        row, column = (place // cells.side for place in np.nonzero(near))
        along[sort, near] = _square_along(cells.tangents[:, :, row, column], *away, x_axis)
    return Edges(distance, along)


def _from_border(gaps: Mask) -> Floats:
    """Return the distance from the border of the image but for what of it lies in gaps, in px."""
    inner = np.zeros_like(gaps)
    inner[1:-1, 1:-1] = True
    return _distance_from(~(inner | gaps))


def _from_regions(outside: Mask) -> Floats:
    """Return the distance from the outermost pixels of regions, in px; 0 outside."""
    return np.maximum(_distance_from(outside) - 1.0, 0.0)


def _distance_from(mask: Mask) -> Floats:
    """Return the distance from a mask's nearest pixel, in px; infinite where there is none."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    return distance_inside(~mask).astype(np.float64)


def _rising(distance: Floats, where: Mask) -> tuple[Floats, Floats]:
    """Return the unit vectors along columns and rows (n,) in which a distance rises; 0 where it does not."""
    row, column = np.nonzero(where)
    last_row, last_column = (size - 1 for size in distance.shape)

    def at(down: int, right: int) -> Floats:
        return distance[np.clip(row + down, 0, last_row), np.clip(column + right, 0, last_column)]

    right, down = at(0, 1) - at(0, -1), at(1, 0) - at(-1, 0)
    length = np.hypot(right, down)
    length = np.where(length > 0.0, length, 1.0)
    return right / length, down / length


def _factors(shared: SharedErrors, sort: int, part: float) -> tuple[EdgeFactors | None, EdgeFactors | None]:
    """Return what edges of a sort do to errors of shape and of the match, over discs of a part of the radius.

    None for errors that are independent from pixel to pixel: a disc's own points tell all of these.
    """
    disc = part * shared.disc_radius_px
    shape, match = shared.averaging_radius_px, shared.subset_radius_px
    rim = float(RIM) if sort == 0 else shared.match_margin_px  # of the image, of a region
    return (
        edge_factors("shape", shape, _RIMS_OF_SHAPE[sort], disc) if shape > 0.0 else None,
        edge_factors("match", match, rim, disc) if match > 0.0 else None,
    )


@uncounted_kernel
def _noise_rows(
    start: int,
    stop: int,
    own: Floats,
    match: Floats,
    distance: Floats,
    along: Floats,
    factors: Floats,
    per_px: float,
    total: Floats,
) -> None:
    """Fill the variance of strain for rows start .. stop.

    `factors` (2, 2, 2, n) are by the sort of the edge, the filter, and whether slopes are across or along it,
    told `per_px` to a pixel of the distance.
    """
    last = factors.shape[3] - 1
    for r in range(start, stop):
        for c in range(own.shape[2]):
            most_xx = own[0, r, c] + match[0, r, c]
            most_yy = own[1, r, c] + match[1, r, c]
            most_xy = own[2, r, c] + match[2, r, c]
            beside_edge = False
            for sort in range(2):
                at = distance[sort, r, c] * per_px
                if not at < last:
                    continue
                k = int(at)
                part = at - k
                square = along[sort, r, c]
                sum_xx = sum_yy = sum_xy = 0.0
                for one in range(2):
                    across = (1.0 - part) * factors[sort, one, 0, k] + part * factors[sort, one, 0, k + 1]
                    beside = (1.0 - part) * factors[sort, one, 1, k] + part * factors[sort, one, 1, k + 1]
                    xx = own[0, r, c] if one == 0 else match[0, r, c]
                    yy = own[1, r, c] if one == 0 else match[1, r, c]
                    xy = own[2, r, c] if one == 0 else match[2, r, c]
                    both = xx + yy
                    xx *= across + square * (beside - across)
                    yy *= beside + square * (across - beside)
                    sum_xx += xx
                    sum_yy += yy
                    if both != 0.0:  # what is not known stays so
                        sum_xy += xy * (xx + yy) / both
                if beside_edge:
                    sum_xx, sum_yy, sum_xy = max(most_xx, sum_xx), max(most_yy, sum_yy), max(most_xy, sum_xy)
                most_xx, most_yy, most_xy, beside_edge = sum_xx, sum_yy, sum_xy, True
            total[0, r, c], total[1, r, c], total[2, r, c] = most_xx, most_yy, most_xy


def noise_at_edges(
    own: Floats, match: Floats, edges: Edges, shared: SharedErrors, part: float, threads: int = 1
) -> Floats:
    """Return the variance of strain by noise, (3, rows, columns): xx, yy, xy.

    Parameters
    ----------
    own, match
        (3, rows, columns): its variance by errors of shape and by those of the match, as if far from edges.
    edges
        Of the image; along x.
    shared
        How far errors go together.
    part
        Of the gauge length.
    threads
        How many threads to use; the result does not depend on it.
    """
    every = [_factors(shared, sort, part) for sort in (0, 1)]
    reach = max((one.distance[-1] for pair in every for one in pair if one is not None), default=0.0)
    told = np.arange(int(reach * _PER_PX) + 2) / _PER_PX
    factors = np.ones((2, 2, 2, len(told)))
    for sort, pair in enumerate(every):
        for one, found in enumerate(pair):
            if found is not None:
                factors[sort, one, 0] = np.interp(told, found.distance, found.across)
                factors[sort, one, 1] = np.interp(told, found.distance, found.along)
    total = np.empty_like(own)

    def work(start: int, stop: int) -> None:
        _noise_rows(start, stop, own, match, edges.distance, edges.along, factors, _PER_PX, total)

    in_row_blocks(work, own.shape[1], threads)
    return total


def _square_along(tangents: Floats, column: Floats, row: Floats, x_axis: Floats) -> Floats:
    """Return the squared cosine (n,) between an axis in the surface and edges across (column, row) (n,).

    `tangents` (2, 3, n) are those of the surface along columns and rows.
    """
    edge = row * tangents[0] - column * tangents[1]
    normal = np.cross(tangents[0], tangents[1], axis=0)
    size = np.sum(normal**2, axis=0)
    height = np.where(size > 0.0, (x_axis @ normal) ** 2 / np.where(size > 0.0, size, 1.0), 0.0)
    length = np.sum(edge**2, axis=0) * (1.0 - height)
    known = length > 0.0
    return np.where(known, np.minimum((x_axis @ edge) ** 2 / np.where(known, length, 1.0), 1.0), 0.5)
