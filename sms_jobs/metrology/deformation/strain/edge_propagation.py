"""By how much more an edge lets errors of displacement disturb strain: exact propagation of white noise.

Beside a straight edge a filter depends on the distance from it, and along it on differences of place alone:
it is propagated for one wave along the edge after the other. All filters here are the same in both directions
along it, so that every transform is real.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.fields.displacement import blending_reach

FilterKind: TypeAlias = Literal["match", "shape"]

_BLENDING = blending_reach(1, 6)  # in subset radii, of matches of first order
_CELLS = 6.0, 30.0  # to a filter's radius and to a disc's, at most: twice as many change a deviation by 5 %
_LEAST_CELLS = 4.0  # to a disc's radius
_RATIOS = 0.1, 2.0  # of the filter's radius to the disc's: beyond, factors are those at the limit
_WIDEST_RIM = {"match": 1.0, "shape": 0.5}  # in radii: beyond, hardly any value reaches the edge
_PLACES = 12  # distances from the edge for which factors are computed
_DIGITS = 3  # of the lengths for which they are remembered


@dataclass(frozen=True)
class EdgeFactors:
    """What an edge makes of the variance of slopes, over that far from it.

    Attributes
    ----------
    distance
        (n,), from the outermost pixel, in px; at the last nothing is left of the edge.
    across, along
        (n,), of slopes across the edge and along it.
    """

    distance: Floats
    across: Floats
    along: Floats


@dataclass(frozen=True)
class _Strip:
    """Cells beside an edge, and waves along it; lengths in px, 0 is the middle of the outermost pixel.

    Attributes
    ----------
    x
        (n,), middles of the cells.
    used
        (n,), the part of each that is not in the rim.
    y
        (m,), places along the edge, on both sides of 0.
    cosine, sine
        (m, waves), of y.
    """

    x: Floats
    used: Floats
    y: Floats
    cosine: Floats
    sine: Floats


def edge_factors(kind: FilterKind, radius: float, rim: float, disc: float) -> EdgeFactors:
    """Return what a straight edge makes of the variance of slopes over discs.

    Parameters
    ----------
    kind
        `match` for blended subsets of first order, `shape` for values of local planes.
    radius
        Of the filter, in px, more than 0.
    rim
        In px: pixels at an edge of which nothing is used, but which have a displacement.
    disc
        Radius of the disc, in px.
    """
    ratio = min(max(radius / disc, _RATIOS[0]), _RATIOS[1])
    least = min(rim, _WIDEST_RIM[kind] * radius)
    return _factors(kind, *(float(f"{length:.{_DIGITS}g}") for length in (radius, least, radius / ratio)))


@lru_cache(maxsize=64)
def _factors(kind: FilterKind, radius: float, rim: float, disc: float) -> EdgeFactors:
    """Do the work of `edge_factors`."""
    around = (1.0 + _BLENDING if kind == "match" else 2.0) * radius
    far = disc + around + rim
    size = min(max(1.0, radius / _CELLS[0], disc / _CELLS[1]), disc / _LEAST_CELLS)
    strip = _strip(size, far + disc + around, disc + around, rim)
    places = np.unique(np.rint(far / size * np.linspace(0.0, 1.0, _PLACES) ** 1.5).astype(int))
    distance = strip.x[places]
    discs = _slopes(strip, distance, disc)
    seen = (_through_matches if kind == "match" else _through_planes)(strip, discs, radius)
    # Waves between the first and the last stand for two each, and a cell for as many pixels as are used.
    twice = np.full(seen.shape[0], 2.0)
    twice[0] = 1.0
    variance = np.einsum("k,kdx,x->d", twice, seen**2, strip.used).reshape(2, -1)
    across, along = variance / variance[:, -1:]
    return EdgeFactors(distance, across, along)


def _strip(size: float, depth: float, half: float, rim: float) -> _Strip:
    """Return a strip of cells of a size, to a depth, and as far along the edge as a filter reaches."""
    inner = np.arange(int(np.ceil(depth / size)) + 1, dtype=np.float64)
    reach = int(np.ceil(half / size)) + 1
    y = size * np.arange(-reach, reach + 1, dtype=np.float64)
    wave = 2.0 * np.pi * np.arange(reach + 1) / (len(y) * size)
    phase = np.outer(y, wave)
    used = np.clip(inner + 1.0 - rim / size, 0.0, 1.0)
    return _Strip((inner + 0.5) * size - 0.5, used, y, np.cos(phase), np.sin(phase))


def _slopes(strip: _Strip, distance: Floats, disc: float) -> Floats:
    """Return transforms of slopes by least squares over discs, (waves, 2 n, cells): across, then along.

    Each as a multiple of what it makes of white noise: a disc that is cut is told by its own points.
    """
    off = strip.x - distance[:, None]
    inside = (off[:, :, None] ** 2 + strip.y**2 <= disc**2).astype(np.float64)
    count = inside.sum(axis=2)
    off -= ((off * count).sum(axis=1) / count.sum(axis=1))[:, None]
    across = off[:, :, None] * (inside @ strip.cosine)
    along = (inside * strip.y) @ strip.sine
    across /= np.sqrt((off**2 * count).sum(axis=1))[:, None, None]
    along /= np.sqrt((inside * strip.y**2).sum(axis=(1, 2)))[:, None, None]
    return np.ascontiguousarray(np.moveaxis(np.concatenate([across, along]), 2, 0))


@dataclass(frozen=True)
class _Weights:
    """Weights (1 - d^2 / reach^2)^2 between cells.

    Attributes
    ----------
    total
        (cells, cells), their sums along the edge.
    even, odd
        (waves, cells, cells), their transforms, and those of weights times the place along the edge.
    """

    total: Floats
    even: Floats
    odd: Floats


def _weights(strip: _Strip, reach: float) -> _Weights:
    """Return the weights of cells to each other within a reach in px."""
    cells = len(strip.x)
    apart = (strip.x[1] - strip.x[0]) * np.arange(cells)
    square = (apart[:, None] ** 2 + strip.y**2) / reach**2
    weight = np.where(square < 1.0, (1.0 - square) ** 2, 0.0)
    between = np.abs(np.subtract.outer(np.arange(cells), np.arange(cells)))
    even, odd = strip.cosine.T @ weight.T, strip.sine.T @ (weight * strip.y).T
    return _Weights(weight.sum(axis=1)[between], even[:, between], odd[:, between])


def _through_planes(strip: _Strip, discs: Floats, radius: float) -> Floats:
    """Return what discs see of noise through `average_in_region`, (waves, discs, cells).

    The radius is doubled for places about which fewer than half the disc's pixels are used.
    """
    near, wide = _weights(strip, radius), _weights(strip, 2.0 * radius)
    apart = strip.x - strip.x[:, None]
    held = 2.0 * np.sqrt(np.maximum(radius**2 - apart**2, 0.0)) @ strip.used
    few = 2.0 * held * (strip.x[1] - strip.x[0]) < np.pi * radius**2
    line = np.where(few[:, None], wide.total, near.total) * strip.used
    zeroth, first, second = line.sum(axis=1), (line * apart).sum(axis=1), (line * apart**2).sum(axis=1)
    share = (second[:, None] - first[:, None] * apart) / (zeroth * second - first**2)[:, None]
    seen: Floats = discs @ (np.where(few[:, None], wide.even, near.even) * share)
    return seen


def _through_matches(strip: _Strip, discs: Floats, radius: float) -> Floats:
    """Return what discs see of noise through `blend_matches`, (waves, discs, cells).

    A match is at every cell of which half is used. Its subset, cut at the rim, is a rectangle, so that what a
    plane is fitted by are products: mean or slope across the edge, times mean or slope along it.
    """
    matched = strip.used >= 0.5
    at = strip.x[matched]
    inside = np.abs(strip.x - at[:, None]) < radius + 0.501
    held = np.where(inside, strip.used, 0.0)
    count = held.sum(axis=1)
    middle = (held @ strip.x) / count
    off = strip.x - middle[:, None]
    spread = (held * off**2).sum(axis=1)
    mean, slope = inside / count[:, None], np.where(inside, off, 0.0) / spread[:, None]
    side = np.abs(strip.y) < radius + 0.501
    even = (side / np.count_nonzero(side)) @ strip.cosine
    odd = (np.where(side, strip.y, 0.0) / np.sum(strip.y[side] ** 2)) @ strip.sine
    weights = _weights(strip, _BLENDING * radius)
    precision = 1.0 / (1.0 / count + (at - middle) ** 2 / spread)
    share = precision / (weights.total[:, matched] @ precision)[:, None]
    by_mean = weights.even[:, :, matched] * share * even[:, None, None]
    blended = discs @ by_mean
    across = (discs * strip.x) @ by_mean - blended * middle
    along = discs @ (weights.odd[:, :, matched] * share * odd[:, None, None])
    seen: Floats = (blended + along) @ mean + across @ slope
    return seen
