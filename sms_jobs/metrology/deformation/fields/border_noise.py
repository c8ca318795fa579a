"""What borders do to blended matches: there they say more than they hold, or share less.

Beside a border subsets are cut and all matches lie to one side. Those of second order tell what lies beyond
their middles by curvatures that only half of a subset knows; those of first order a few px further in have
their middles off their points, and errors that cancel in the blend. Their own variances tell neither.
Where a displacement bends, nothing cancels beside a border; by how much the matches differ tells that, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import fft

from sms_jobs.metrology.arrays import Floats, Labels, Singles
from sms_jobs.metrology.deformation.matching.subsets import RIM
from sms_jobs.metrology.images.masks import beside_another_label, distance_inside, wide_gaps

RADIUS = 12
"""Of the subsets that are summed, in px: in proportion to their size all are alike."""
_DEEP = 3
"""Radii of a subset from a border, beyond which it changes nothing."""
_ABOUT = 0.1
"""In reaches: matches whose middle is nearer lie about the pixel, and their textures alone weigh unevenly."""
_BENDS = {3: 2, 6: 3}
"""By the numbers that subsets tell of either component: the least power of distance that they do not know."""


def beside_borders(labels: Labels, radius: int, reach: float, terms: int) -> tuple[Floats, Floats]:
    """Return what borders make of the noise of blended matches, (rows, columns) each.

    The factor on the variance by noise, and what noise alone makes the matches about a pixel differ by,
    squared, over the mean of their variances: beside the border of the image, where subsets end `RIM` px
    before it, times beside an edge.

    Parameters
    ----------
    labels
        (rows, columns), regions that subsets are cut to; 0 for none. Gaps narrower than `radius` are none.
    radius
        Of the subsets, in px.
    reach
        Distance over which matches are blended, in radii.
    terms
        Numbers that subsets tell of either component: 3 of first order, 6 of second.
    """

    def told(rim: int) -> tuple[Floats, Floats]:
        beside = _beside_a_border(reach, terms, rim)
        return beside.variance / beside.variance[-1], beside.scatter / beside.scatter[-1]

    factors, scatter = by_borders(labels, radius, told)
    return factors, scatter * _beside_a_border(reach, terms, 0).scatter[-1]


def bias_by_scatter(aside: Floats, reach: float, terms: int) -> Floats:
    """Return the square of what blended matches are off by, over what their matches differ by beyond noise.

    Where all matches lie to one side and the displacement bends across the border, by the least power of the
    distance that subsets do not know. `aside` is how far the middle of the matches is from the pixel, in
    those of the reach: the ratio is about the same for the border of an image and any other. Other arguments
    are those of `beside_borders`.
    """
    beside = _beside_a_border(reach, terms, RADIUS // 2)
    one_sided = aside >= _ABOUT
    ratio = np.zeros(aside.shape)
    ratio[one_sided] = np.interp(aside[one_sided], beside.aside[::-1], beside.bias[::-1])
    return ratio


def by_borders(labels: Labels, radius: int, told: Callable[[int], tuple[Floats, ...]]) -> tuple[Floats, ...]:
    """Return what borders do at pixels (rows, columns), by what is told at `depths` for a rim."""
    scale = (radius + 0.5) / (RADIUS + 0.5)
    rim = min(round(RIM / scale), RADIUS // 2)  # beyond, too little of a subset is left to be matched
    deep = RIM + int(np.ceil(scale * (_DEEP * RADIUS + 0.5)))
    within = (np.arange(deep + 1) - RIM + 0.5) / scale - 0.5
    from_edges = _from_edges(labels, radius)
    near = from_edges < _DEEP * (radius + 0.5)
    inside = (from_edges[near] + 0.5) / scale - 0.5
    found = []
    for of_image, of_edge in zip(told(rim), told(0), strict=True):
        each = _from_the_border(np.interp(within, depths(rim), of_image), labels.shape)
        each[near] *= np.interp(inside, depths(0), of_edge)
        found.append(each)
    return tuple(found)


def _from_the_border(values: Floats, shape: tuple[int, int]) -> Floats:
    """Return what is told at 0, 1, 2 .. px from an image's border, (rows, columns); the last further in."""
    whole = np.full(shape, values[-1])
    for distance, value in enumerate(values[: (min(shape) + 1) // 2]):
        ring = whole[distance : shape[0] - distance, distance : shape[1] - distance]
        ring[[0, -1]] = value
        ring[:, [0, -1]] = value
    return whole


def depths(rim: int) -> Floats:
    """Return the distances that are summed for, in px from the outermost pixel of a subset of `RADIUS`."""
    return np.concatenate([[-rim - 0.5], np.arange(-rim, _DEEP * RADIUS + 1)])


@dataclass(frozen=True)
class SeenBeside:
    """What a blended match beside a border makes of white noise of variance 1.

    Attributes
    ----------
    weights
        (rows, columns), of the pixels in it.
    own, told
        Mean variances of the matches that it is made of: at their own points, and of what they tell at its.
    aside
        How far the middle of these is from it, in those of the reach.
    bend
        Square of what it is off by where the displacement bends across the border as its subsets cannot, and
        of what its matches differ by then.
    """

    weights: Floats
    own: float
    told: float
    aside: float
    bend: tuple[float, float]

    @property
    def variance(self) -> float:
        """That of the blended match."""
        return float(np.sum(self.weights**2))

    @property
    def scatter(self) -> float:
        """By how much, squared, its matches differ at its point."""
        return self.told - self.variance


def _fits(
    radius: int, rim: int, last: int, terms: int, rows: int
) -> list[tuple[int, Floats, Floats, Floats]]:
    """Return of matches -rim .. last px from a border the first column, weights of pixels, covariance, bend.

    The weights (terms, rows / 2, columns) are transformed along the border, the covariance is (terms, terms),
    and the last (terms,) what they take the least power of the distance for that they do not know.
    """
    down = np.arange(-radius, radius + 1.0)[:, None]
    found = []
    for place in range(-rim, last + 1):
        right = np.arange(max(-radius, -place), radius + 1.0)
        basis = _basis(right, down, terms)
        flat = np.linalg.pinv(basis.reshape(terms, -1)).T  # (terms, pixels)
        fit = flat.reshape(basis.shape)
        power: Floats = np.broadcast_to(right ** _BENDS[terms], basis.shape[1:]).ravel()
        found.append((place + int(right[0]), fft.rfft(fit, rows, axis=1), flat @ flat.T, flat @ power))
    return found


def _basis(x: Floats, y: Floats, terms: int) -> Floats:
    """Return what each number of a displacement adds at places, (terms, ...)."""
    every = np.broadcast_arrays(np.ones_like(x * y), x, y, 0.5 * x**2, x * y, 0.5 * y**2)
    return np.stack(every)[:terms]


def seen_beside_a_border(
    terms: int, reach: float, rim: int, radius: int = RADIUS, margin: int = 0
) -> Iterator[SeenBeside]:
    """Yield what blended matches at `depths` make of noise, and of a bend.

    `terms` are the numbers that subsets tell of either component: 3 of first order, 6 of second. Of subsets
    of a radius up to `RADIUS` about every pixel, also `rim` px beyond where they are cut, and weights of
    `blend_matches`. Subsets are cut `margin` px further in than distances are counted from.
    """
    far = reach * radius
    wide = int(np.ceil(far))
    rows, last = 6 * RADIUS + 1, _DEEP * RADIUS + wide
    fits = _fits(radius, min(rim, radius // 2), last, terms, rows)
    down = np.arange(-wide, wide + 1.0)
    for depth in depths(rim):
        pixels = np.zeros((_DEEP * RADIUS + 3 * RADIUS, rows // 2 + 1), dtype=complex)
        each = []
        for place, (first, fit, covariance, bend) in enumerate(fits, start=-min(rim, radius // 2)):
            off = depth - margin - place
            if abs(off) >= far:
                continue
            weight = np.maximum(1.0 - (off**2 + down**2) / far**2, 0.0) ** 2 / covariance[0, 0]
            basis = _basis(np.full_like(down, off), -down, terms)
            told = np.average(np.sum(basis * (covariance @ basis), axis=0), weights=weight)
            wrong = basis[:, wide] @ bend - off ** _BENDS[terms]
            each.append((weight.sum(), covariance[0, 0], told, off, wrong, wrong**2))
            at = np.s_[margin + first : margin + first + fit.shape[2]]
            pixels[at] += np.einsum("tk,tki->ik", fft.rfft(basis * weight, rows, axis=1), fit)
        share, *others = np.array(each).T
        own, told, off, wrong, square = (float(np.average(one, weights=share)) for one in others)
        weights = fft.irfft(pixels, rows, axis=1) / share.sum()
        yield SeenBeside(weights, own, told, abs(off) / far, (wrong**2, square - wrong**2))


@dataclass(frozen=True)
class _Beside:
    """What a straight border makes of blended matches at `depths`.

    Attributes
    ----------
    variance, scatter
        Of white noise, over the mean of the matches' own variances.
    aside
        How far the middle of the matches is from the pixel, in those of the reach.
    bias
        Square of what bends make them off by, over what they make the matches differ by.
    """

    variance: Floats
    scatter: Floats
    aside: Floats
    bias: Floats


@cache
def _beside_a_border(reach: float, terms: int, rim: int) -> _Beside:
    seen = [
        (one.variance / one.own, one.scatter / one.own, one.aside, one.bend[0] / one.bend[1])
        for one in seen_beside_a_border(terms, reach, rim)
    ]
    return _Beside(*np.array(seen).T)


def _from_edges(labels: Labels, smallest: int) -> Singles:
    """Return the distance from the edges of regions, (rows, columns) in px; the image's border is none."""
    away = np.full(labels.shape, np.float32(np.inf))
    gap, touching = wide_gaps(labels, smallest), beside_another_label(labels)
    if gap.any():
        away = np.maximum(distance_inside(~gap) - np.float32(1.0), np.float32(0.0))
    if touching.any():
        away = np.minimum(away, distance_inside(~touching))
    return away
