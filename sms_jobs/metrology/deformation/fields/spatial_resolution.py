"""Spatial resolution: the period of a wave of displacement or strain of which 90 % of the amplitude is left.

What subsets, blending, averaging and gauge leave of a wave follows from what each does to one, which is
linear where a wave is small beside a speckle; what it leaves of a wave along the image's axes is told.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.deformation.fields.displacement import blending_reach
from sms_jobs.metrology.deformation.matching.shape_functions import ShapeOrder
from sms_jobs.metrology.images.masks import box_of, grown

KEPT = 0.9
"""Part of the amplitude that is left at the period that is called the spatial resolution."""

_SHORTEST, _LONGEST, _PERIODS = 0.7, 12.0, 64  # periods that are looked at, in sides of a subset
_FALLS_WITH = 4  # power of the period with which what blended subsets take of a wave falls


@dataclass(frozen=True)
class Response:
    """What subsets find of a wave of amplitude 1 about their centre.

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


def response_of_subsets(radius: int, order: ShapeOrder, periods: Floats) -> Response:
    """Return what subsets of a radius in px and an order find of waves along rows or columns, (k,) in px.

    Notes
    -----
    Where slopes are alike everywhere a match is the least-squares fit of its shape function over the square
    (Schreier & Sutton 2002), and along a wave that of a polynomial: Savitzky & Golay's filter.
    """
    place = np.arange(-radius, radius + 1.0)
    basis = np.stack([np.ones_like(place), place, 0.5 * place**2], axis=1)[:, : order + 1]
    angle = 2.0 * np.pi * place[:, None] / periods
    fit = np.linalg.pinv(basis)
    even, odd = fit @ np.cos(angle), fit @ np.sin(angle)
    none = np.zeros_like(periods)
    return Response(periods, even[0], odd[1] if order > 0 else none, even[2] if order > 1 else none)


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


def left_by_square(periods: Floats) -> Floats:
    """Return what is left of strain that is a wave (k,) over squares of pixels, of periods in sides.

    Across a wave lines are averaged, which leaves sin(z) / z of it with z = pi side / period; lines along it
    leave more, 3 (sin(z) - z cos(z)) / z^3.
    """
    return np.asarray(np.sinc(1.0 / periods))


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


def strain_resolution(
    displacement: NDArray[np.floating],
    gauge_length: float,
    left: Callable[[Floats], Floats] = left_by_gauge,
) -> Floats:
    """Return the spatial resolution of strain over gauges, of displacement that has one of its own.

    Parameters
    ----------
    displacement
        (...), the resolution of displacement, in any unit of length; NaN for none.
    gauge_length
        In the same unit.
    left
        What gauges leave of waves of strain, of periods (k,) in gauge lengths.

    Notes
    -----
    What both leave of a wave is multiplied. What blended subsets take falls with the fourth power of the
    period: slope and blending are such that the second has nothing, see `blend_matches`.
    """
    periods = np.geomspace(0.5, 50.0, 400)
    ratio = np.concatenate([[0.0], np.geomspace(0.02, 40.0, 200)])
    gauge = left(periods)
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
    whole = np.full(labels.shape, np.nan)
    part = grown(box_of(known), radius)
    xyz, labels, known = xyz[:, *part], labels[part], known[part]
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
    whole[part] = np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
    return whole
