"""Spatial resolution: the period of a wave of displacement or strain of which 90 % of the amplitude is left.

What subsets, blending, averaging and gauge leave of a wave follows from what each does to one, which is
linear where a wave is small beside a speckle. Only subsets depend on the texture: they see a displacement
where there are slopes, and that by least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sms_jobs.metrology.deformation.correlation import PreparedImages
from sms_jobs.metrology.deformation.displacement import blending_reach
from sms_jobs.metrology.deformation.shape_functions import ShapeOrder

Floats: TypeAlias = NDArray[np.float64]
Labels: TypeAlias = NDArray[np.int32]
Ints: TypeAlias = NDArray[np.int64]

KEPT = 0.9
"""Part of the amplitude that is left at the period that is called the spatial resolution."""

_SUBSETS = 100  # of the texture that are asked: the mean over them is known to about a hundredth
_SHORTEST, _LONGEST, _PERIODS = 0.7, 12.0, 64  # periods that are looked at, in sides of a subset
_FALLS_WITH = 4  # power of the period with which what blended subsets take of a wave falls


@dataclass(frozen=True)
class Response:
    """What subsets find of a wave of amplitude 1 about their centre, as means over a texture.

    Attributes
    ----------
    periods
        (k,), of the waves in px, ascending.
    value, slope, bend
        (k,), of a cosine its displacement at the centre and its second derivative along the wave, of a sine
        its slope; in px, 1 and 1 / px for an amplitude of 1 px. 0 for what the order has not got.
    """

    periods: Floats
    value: Floats
    slope: Floats
    bend: Floats


def periods_about(radius: int) -> Floats:
    """Return the periods in px among which subsets of a radius have their resolution, ascending."""
    return np.geomspace(_SHORTEST, _LONGEST, _PERIODS) * (2 * radius + 1)


def response_of_subsets(
    images: PreparedImages, x: Ints, y: Ints, radius: int, order: ShapeOrder, periods: Floats
) -> Response:
    """Return what subsets about some points of the reference image find of waves along rows and columns.

    Parameters
    ----------
    images
        Of which the reference, its slopes and its regions count.
    x, y
        (n,), points that were matched, in px; a hundred of them are asked, evenly.
    radius, order
        Of the subsets.
    periods
        (k,), in px.

    Notes
    -----
    A Gauss-Newton fit finds p = (sum J J^T)^-1 sum J (J_u . w) of a small displacement w, with the slopes J
    of the reference along its unknowns, less their parts along a constant and the subset itself (Schreier &
    Sutton 2002, with the texture's own slopes in place of equal ones). Where slopes are alike everywhere that
    is Savitzky and Golay's filter; subsets of few speckles find less of short waves.
    """
    chosen = np.unique(np.linspace(0, len(x) - 1, min(_SUBSETS, len(x))).round().astype(np.int64))
    found = np.zeros((3, len(periods)))
    for k in chosen:
        found += _response_at(images, int(x[k]), int(y[k]), radius, order, periods) / len(chosen)
    return Response(periods, *found)


_TERMS = {0: ((0, 0),), 1: ((0, 0), (1, 0), (0, 1)), 2: ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))}
"""By order, the powers of x and y in u and in v."""


def _response_at(
    images: PreparedImages, x: int, y: int, radius: int, order: ShapeOrder, periods: Floats
) -> Floats:
    """Return value, slope and bend (3, periods): means over u and v, each along rows and columns."""
    rows, columns = images.labels.shape
    box = np.s_[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
    dy = np.arange(rows, dtype=np.float64)[box[0]] - y
    dx = np.arange(columns, dtype=np.float64)[box[1]] - x
    own = (images.labels[box] == images.labels[y, x]).astype(np.float64)
    f = images.reference[box] - np.average(images.reference[box], weights=own)
    terms = _TERMS[order]
    powers = np.stack([dx**i * dy[:, None] ** j for i, j in terms])
    slopes = np.stack([images.gradient_x[box], images.gradient_y[box]]) * own
    j = (slopes[:, None] * powers).reshape(2 * len(terms), *own.shape)
    light = np.stack([own / np.sqrt(own.sum()), own * f / np.sqrt(np.sum(own * f * f))])
    part = np.einsum("tyx,lyx->tl", j, light)
    free = j - np.einsum("tl,lyx->tyx", part, light)
    solve = np.linalg.pinv(np.einsum("tyx,syx->ts", free, j), hermitian=True)
    found = np.zeros((3, len(periods)))
    wave = 2.0 * np.pi / periods
    for axis, (place, along) in enumerate(((dx, 1), (dy, 0))):
        cosine, sine = np.cos(np.outer(place, wave)), np.sin(np.outer(place, wave))
        for component in range(2):
            # Sums across the wave first: only along it does it change.
            across = np.einsum("tyx,yx->ty" if along == 0 else "tyx,yx->tx", free, slopes[component])
            first = component * len(terms)
            fitted = solve[first : first + len(terms)] @ across
            found[0] += 0.25 * fitted[0] @ cosine
            if order > 0:
                found[1] += 0.25 * fitted[1 + axis] @ sine
            if order > 1:
                found[2] += 0.5 * fitted[3 + 2 * axis] @ cosine  # of x^2, half its second derivative
    return found


def left_by_blending(found: Response, radius: int, numbers: int, spacing: int) -> Floats:
    """Return what is left of waves (k,) where matches are spread over the pixels by `blend_matches`.

    Parameters
    ----------
    found
        What subsets of `radius` find of the waves.
    numbers
        Of a warp: 6, or 12 with second derivatives.
    spacing
        Of the matches, in px; the mean over the places that a pixel can have between them is told.
    """
    reach = blending_reach(radius, numbers)
    wide = int(np.ceil(reach))
    dy, dx = np.mgrid[-wide : wide + 1, -wide : wide + 1]
    weight = np.maximum(1.0 - (dx**2 + dy**2) / reach**2, 0.0) ** 2
    # Pixels whose matches are the same way off form a class; each class has its weights add up to 1.
    of_class = (dy % spacing) * spacing + dx % spacing
    total = np.bincount(of_class.ravel(), weight.ravel(), spacing**2)
    share = np.where(weight > 0.0, weight / np.where(total > 0.0, total, 1.0)[of_class], 0.0)
    along = share.sum(axis=0) / np.count_nonzero(total)
    place = np.arange(-wide, wide + 1.0)[:, None]
    cosine, sine = (of(2.0 * np.pi * place / found.periods) for of in (np.cos, np.sin))
    return np.asarray(
        along @ (found.value * cosine + found.slope * place * sine + found.bend * 0.5 * place**2 * cosine)
    )


def left_by_averaging(radius: float, periods: Floats) -> Floats:
    """Return what is left of waves (k,) where `average_in_region` has averaged them over a radius in px.

    The transform of (1 - d^2 / radius^2)^2 is 48 J3(q) / q^3 with q = 2 pi radius / period.
    """
    q = 2.0 * np.pi * radius / periods
    return np.where(q > 0.01, 48.0 * special.jv(3, q) / np.maximum(q, 0.01) ** 3, 1.0)


def left_by_gauge(periods: Floats) -> Floats:
    """Return what is left of strain that is a wave (k,) in a gauge disc, of periods in gauge lengths.

    A slope by least squares over a disc leaves 8 J2(z) / z^2 of it, with z = pi gauge length / period.
    """
    z = np.pi / periods
    return np.where(z > 0.01, 8.0 * special.jv(2, z) / np.maximum(z, 0.01) ** 2, 1.0)


def resolution_of(periods: Floats, left: Floats) -> float:
    """Return the longest period at which `KEPT` of the amplitude is left; NaN where more is taken of all.

    Parameters
    ----------
    periods, left
        (k,), ascending, and what is left there; where more than `KEPT` is left of all it is the shortest.
    """
    below = np.flatnonzero(~(left >= KEPT))
    if not len(below):
        return float(periods[0])
    last = int(below[-1])
    if last == len(periods) - 1:
        return float("nan")
    part = (KEPT - left[last]) / (left[last + 1] - left[last])
    return float(periods[last] + part * (periods[last + 1] - periods[last]))


def strain_resolution(displacement: NDArray[np.floating], gauge_length: float) -> Floats:
    """Return the spatial resolution of strain over gauge discs, of displacement that has one of its own.

    Parameters
    ----------
    displacement
        (...), the resolution of displacement, in any unit of length; NaN for none.
    gauge_length
        In the same unit.

    Notes
    -----
    What both leave of a wave is multiplied. What blended subsets take falls with the fourth power of the
    period: slope and blending are such that the second has nothing, see `blend_matches`.
    """
    periods = np.geomspace(0.5, 50.0, 400)
    ratio = np.concatenate([[0.0], np.geomspace(0.02, 40.0, 200)])
    gauge = left_by_gauge(periods)
    table = [
        resolution_of(periods, gauge * (1.0 - (1.0 - KEPT) * (one / periods) ** _FALLS_WITH)) for one in ratio
    ]
    given = np.asarray(displacement, dtype=np.float64) / gauge_length
    found = np.where(given <= ratio[-1], np.interp(given, ratio, table), given)
    return np.asarray(np.where(np.isfinite(given), gauge_length * found, np.nan))


def pixel_extent(xyz: Floats, labels: Labels, radius: int) -> Floats:
    """Return what a pixel covers of the surface in the direction in which that is most.

    Parameters
    ----------
    xyz
        (3, rows, columns), positions in any unit of length, NaN where there is none.
    labels
        (rows, columns), continuous regions, 0 for none.
    radius
        In px: means are taken over the steps between pixels in squares of 2 radius + 1.

    Returns
    -------
    (rows, columns), in that unit; NaN where no two pixels of a region are near. It is the larger singular
    value of the surface's derivatives along the image's axes.
    """
    import cv2

    size = (2 * radius + 1, 2 * radius + 1)
    along = []
    known = np.isfinite(xyz).all(axis=0) & (labels > 0)
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])):
        together = np.zeros(labels.shape)
        together[first] = (labels[first] == labels[second]) & known[first] & known[second]
        count = cv2.boxFilter(together, -1, size, borderType=cv2.BORDER_CONSTANT)
        step = np.zeros(xyz.shape)
        for axis in range(3):
            forward = xyz[axis][second] - xyz[axis][first]
            step[axis][first] = np.where(together[first] > 0.0, forward, 0.0)
            step[axis] = cv2.boxFilter(step[axis], -1, size, borderType=cv2.BORDER_CONSTANT)
        enough = count > 0.5 / (size[0] * size[1])
        along.append(np.where(enough, step / np.where(enough, count, 1.0), np.nan))
    xx, xy, yy = (np.sum(a * b, axis=0) for a, b in ((along[0],) * 2, along, (along[1],) * 2))
    return np.asarray(np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)))
