"""What borders do to the noise of blended matches: there they say more than they hold, or share less.

Beside a border subsets are cut and all matches lie to one side. Those of second order tell what lies beyond
their middles by curvatures that only half of a subset knows; those of first order a few px further in have
their middles off their points, and errors that cancel in the blend. Their own variances tell neither.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
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


def border_factors(labels: Labels, radius: int, reach: float) -> Floats:
    """Return the factor (rows, columns) on the variance by noise of blended matches of second order.

    That beside the border of the image, where subsets end `RIM` px before it, times that beside an edge.

    Parameters
    ----------
    labels
        (rows, columns), regions that subsets are cut to; 0 for none. Gaps narrower than `radius` are none.
    radius
        Of the subsets, in px.
    reach
        Distance over which matches are blended, in radii.
    """
    return by_borders(labels, radius, lambda rim: _beside_a_border(reach, rim))


def by_borders(labels: Labels, radius: int, told: Callable[[int], Floats]) -> Floats:
    """Return what borders do at pixels (rows, columns), by what is told at `depths` for a rim."""
    scale = (radius + 0.5) / (RADIUS + 0.5)
    rim = min(round(RIM / scale), RADIUS // 2)  # beyond, too little of a subset is left to be matched
    down, right = (np.minimum(np.arange(n), np.arange(n)[::-1]) for n in labels.shape)
    from_border = np.minimum(down[:, None], right)
    of_image = np.interp((np.arange(from_border.max() + 1) - RIM + 0.5) / scale - 0.5, depths(rim), told(rim))
    found = of_image[from_border]
    from_edges = _from_edges(labels, radius)
    near = from_edges < _DEEP * (radius + 0.5)
    found[near] *= np.interp((from_edges[near] + 0.5) / scale - 0.5, depths(0), told(0))
    return np.asarray(found)


def depths(rim: int) -> Floats:
    """Return the distances that are summed for, in px from the outermost pixel of a subset of `RADIUS`."""
    return np.concatenate([[-rim - 0.5], np.arange(-rim, _DEEP * RADIUS + 1)])


def _fits(radius: int, rim: int, last: int, terms: int, rows: int) -> list[tuple[int, Floats, float]]:
    """Return of matches -rim .. last px from a border their first column, weights of pixels and variance.

    The weights (terms, rows / 2, columns) are transformed along the border.
    """
    down = np.arange(-radius, radius + 1.0)[:, None]
    found = []
    for place in range(-rim, last + 1):
        right = np.arange(max(-radius, -place), radius + 1.0)
        basis = _basis(right, down, terms)
        fit = np.linalg.pinv(basis.reshape(terms, -1)).T.reshape(basis.shape)
        found.append((place + int(right[0]), fft.rfft(fit, rows, axis=1), float(np.sum(fit[0] ** 2))))
    return found


def _basis(x: Floats, y: Floats, terms: int) -> Floats:
    """Return what each number of a displacement adds at places, (terms, ...)."""
    every = np.broadcast_arrays(np.ones_like(x * y), x, y, 0.5 * x**2, x * y, 0.5 * y**2)
    return np.stack(every)[:terms]


def seen_beside_a_border(
    terms: int, reach: float, rim: int, radius: int = RADIUS, margin: int = 0
) -> Iterator[tuple[Floats, float]]:
    """Yield what pixels (rows, columns) weigh in blended matches at `depths`, and the matches' mean variance.

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
        total = stated = 0.0
        for place, (first, fit, variance) in enumerate(fits, start=-min(rim, radius // 2)):
            off = depth - margin - place
            if abs(off) >= far:
                continue
            weight = np.maximum(1.0 - (off**2 + down**2) / far**2, 0.0) ** 2 / variance
            total += float(weight.sum())
            stated += float(weight.sum()) * variance
            said = fft.rfft(_basis(np.full_like(down, off), -down, terms) * weight, rows, axis=1)
            at = np.s_[margin + first : margin + first + fit.shape[2]]
            pixels[at] += np.einsum("tk,tki->ik", said, fit)
        yield fft.irfft(pixels, rows, axis=1) / total, stated / total


@cache
def _beside_a_border(reach: float, rim: int) -> Floats:
    """Return the variance of blended matches over that which is the same far from a straight border.

    Both over the mean of the matches' own variances, at `depths`, of white noise.
    """
    seen = seen_beside_a_border(6, reach, rim)
    ratios = np.array([float(np.sum(weights**2)) / stated for weights, stated in seen])
    return np.asarray(ratios / ratios[-1])


def _from_edges(labels: Labels, smallest: int) -> Singles:
    """Return the distance from the edges of regions, (rows, columns) in px; the image's border is none."""
    away = np.full(labels.shape, np.float32(np.inf))
    gap, touching = wide_gaps(labels, smallest), beside_another_label(labels)
    if gap.any():
        away = np.maximum(distance_inside(~gap) - np.float32(1.0), np.float32(0.0))
    if touching.any():
        away = np.minimum(away, distance_inside(~touching))
    return away
