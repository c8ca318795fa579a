"""Where a displacement jumps: the lines of cracks, from what the images have against it.

Across a crack no subset follows both sides, and the bias that the images find has a ridge along it. A ridge
is a crack where both its sides are quiet and lead to different displacements of it; where a surface only
bends, or is folded, they lead to the same: by parabolas, for straight lines through the sides of a fold miss
each other by its curvature.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from sms_jobs.metrology.arrays import Floats, Labels, Mask
from sms_jobs.metrology.deformation.cracks.curves import course
from sms_jobs.metrology.deformation.cracks.polylines import evened, way_along, ways
from sms_jobs.metrology.deformation.matching.correlation import PreparedImages
from sms_jobs.metrology.deformation.matching.subsets import RIM
from sms_jobs.metrology.deformation.matching.verification import Verified
from sms_jobs.metrology.images.masks import box_of, grown

_SMOOTHED = 0.35  # standard deviation of the filter of ridges, in subset radii
_HIGHEST = 1.0  # px, of a ridge: more says no more
_ABOVE_NOISE = 3.0  # standard deviations of the displacement that a ridge has at least
_STEEP = 0.1  # of a ridge's height: its curvature across, in units of the filter
_ALONG = 0.6  # of its curvature across, that along it
_SIDES = (1.3, 1.7, 2.2, 2.7, 3.2)  # where its sides are looked at, in subset radii
_LEAST_SIDES = 4  # of these, that say something
_LEAST_VARIANCE = 1e-8  # px^2, below which no displacement is known
_QUIET = 0.5  # of a ridge's height, that of its sides at most
_LEAST_LENGTH = 4.0  # of a line, in subset radii
_BY_CHANCE = 1e-3  # jumps that noise alone makes in an image, if every subset were looked at
_LEAST_JUMP_PX = 0.05
_LINKED = 3.0  # subset radii by which points of one line are apart at most
_FACING = 0.7  # cosine of the angle between a line's direction and the way to one that goes on with it
_OTHER = 8.0  # median deviations from which on more says no more
_AS_GOOD = 1.1  # of what is left over as told, what is left over by two sides at most
_TRUNCATED = 4.0  # standard deviations at which a filter ends
_THICK = 3  # px, of a line that is cut


@dataclass(frozen=True)
class _Ridge:
    """Points of a ridge, and what the displacement on either side of it says of them.

    Attributes
    ----------
    place, normal
        (n, 2), as row and column.
    side, slope
        (n, 2, 2): the displacement at the point as a straight line through the side behind and before it has
        it, and its derivative along the normal.
    jump, variance
        (n, 2): the displacement before the line less that behind it in px, by parabolas through the sides,
        and its variance.
    """

    place: Floats
    normal: Floats
    side: Floats
    slope: Floats
    jump: Floats
    variance: Floats

    def where(self, chosen: NDArray[Any]) -> _Ridge:
        return _Ridge(*(values[chosen] for values in vars(self).values()))


def crack_lines(
    images: PreparedImages,
    displacement: Floats,
    variance: Floats,
    verified: Verified,
    labels: Labels,
    radius: int,
) -> Mask:
    """Return the pixels of lines along which a displacement jumps, (rows, columns).

    A line that ends within its region is led on straight to where the region ends: so it parts the region,
    and what is computed on one of its sides takes nothing from the other.

    Parameters
    ----------
    images
        The two images.
    displacement, variance
        (2, rows, columns): u and v in px, and what noise has against them in px^2.
    verified
        What the images have against them.
    labels
        (rows, columns), regions, 0 for none.
    radius
        Of the subsets, in px.
    """
    told = labels > 0
    known = told & np.isfinite(displacement).all(axis=0) & ~verified.unlike
    none = np.zeros_like(told)
    if not known.any():
        return none
    least = _ABOVE_NOISE * float(np.sqrt(np.median(variance.sum(axis=0)[known])))
    height = np.where(known, np.minimum(np.sqrt(verified.bias.sum(axis=0)), _HIGHEST), _HIGHEST)
    # At the image's border matches are carried, and off by that.
    height = np.pad(height[RIM:-RIM, RIM:-RIM], RIM, mode="edge")
    height[~told] = 0.0
    if np.count_nonzero(height > least) < _LEAST_LENGTH * radius * _THICK:
        return none
    part = grown(box_of(told), int(_TRUNCATED * _SMOOTHED * radius) + 1)  # beyond, filters find nothing
    in_part = np.s_[:, *part]
    ridge = _ridge(height[part], least, radius)
    noise = variance[in_part] + verified.bias[in_part]
    ridge = _with_quiet_sides(
        ridge, height[part], displacement[in_part], noise, known[part], labels[part], radius
    )
    ridge = replace(ridge, place=ridge.place + np.array([part[0].start, part[1].start]))
    found, least_jump = [], _least_jump(int(np.count_nonzero(told)), radius)
    for line in _lines(ridge, radius):
        if _jumps(line, radius, least_jump):
            settled = _settled(_even(line, radius), images, displacement, radius)
            if settled is not None:
                found.append(settled)
    return _drawn(found, told, radius) if found else none


def _ridge(height: Floats, least: float, radius: int) -> _Ridge:
    """Return the points at which the filtered height is the largest across a line, jumps not filled in."""
    width = _SMOOTHED * radius
    smooth = ndimage.gaussian_filter(height, width, truncate=_TRUNCATED)
    candidate = smooth > least
    rows, columns = np.nonzero(candidate)
    part = grown(box_of(candidate), int(_TRUNCATED * width) + 1)
    own_rows, own_columns = rows - part[0].start, columns - part[1].start
    rr, rc, cc = (
        ndimage.gaussian_filter(height[part], width, order=order, truncate=_TRUNCATED)[own_rows, own_columns]
        * width**2
        for order in ((2, 0), (1, 1), (0, 2))
    )
    own = smooth[rows, columns]
    half, middle = 0.5 * np.hypot(rr - cc, 2.0 * rc), 0.5 * (rr + cc)
    across, along = middle - half, middle + half
    good = (-across > _STEEP * own) & (np.abs(along) < -_ALONG * across)
    rr, rc, cc, own = rr[good], rc[good], cc[good], own[good]
    angle = 0.5 * np.arctan2(2.0 * rc, rr - cc) + 0.5 * np.pi  # of the least curvature, from rows to columns
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place = np.stack([rows[good], columns[good]], axis=1).astype(np.float64)
    sides = [_at(smooth, place + sign * normal) for sign in (-1.0, 1.0)]
    good = (own >= sides[0]) & (own > sides[1])
    unknown = np.zeros((int(good.sum()), 2, 2))
    return _Ridge(place[good], normal[good], unknown, unknown, unknown[:, 0], unknown[:, 0])


def _at(image: Floats, place: Floats) -> Floats:
    return np.asarray(ndimage.map_coordinates(image, place.T, order=1, mode="nearest"))


def _with_quiet_sides(
    ridge: _Ridge,
    height: Floats,
    displacement: Floats,
    variance: Floats,
    known: Mask,
    labels: Labels,
    radius: int,
) -> _Ridge:
    """Return the points of a ridge on whose sides the displacement is known, with where these lead."""
    lever = np.array(_SIDES) * radius
    filtered = ndimage.gaussian_filter(height, 0.5 * _SMOOTHED * radius)
    own = _at(filtered, ridge.place)[:, None]
    good, label = np.ones(len(own), dtype=bool), []
    side, slope = np.zeros_like(ridge.side), np.zeros_like(ridge.slope)
    jump, spread = np.zeros_like(ridge.jump), np.zeros_like(ridge.variance)
    for number, sign in enumerate((-1.0, 1.0)):
        row, column = np.rint(ridge.place + sign * lever[:, None, None] * ridge.normal).astype(int).T
        inside = (row >= 0) & (row < known.shape[0]) & (column >= 0) & (column < known.shape[1])
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        usable = inside & known[row, column] & (filtered[row, column] < _QUIET * own)
        label.append(np.where(usable, labels[row, column], 0).max(axis=1))
        usable &= labels[row, column] == label[-1][:, None]
        good &= usable.sum(axis=1) >= _LEAST_SIDES
        weight = np.where(usable, 1.0 / np.maximum(variance[:, row, column], _LEAST_VARIANCE), 0.0)
        weight[:, ~good] = 1.0
        told = np.where(usable, displacement[:, row, column], 0.0)
        straight, _ = _led(lever, told, weight, 2)
        bent, of_bent = _led(lever, told, weight, 3)
        side[:, number], slope[:, number] = straight[..., 0].T, sign * straight[..., 1].T
        jump += sign * bent[..., 0].T
        spread += of_bent.T
    good &= label[0] == label[1]
    return _Ridge(ridge.place, ridge.normal, side, slope, jump, spread).where(good)


def _led(lever: Floats, told: Floats, weight: Floats, terms: int) -> tuple[Floats, Floats]:
    """Return polynomials (2, n, terms) by weighted least squares, and the variance (2, n) of their constants.

    `told` and `weight` are (2, n, k), at the k levers.
    """
    powers = np.vander(lever, terms, increasing=True)
    inverse = np.linalg.inv(np.einsum("cnk,ki,kj->cnij", weight, powers, powers))
    return np.einsum("cnij,kj,cnk->cni", inverse, powers, weight * told), inverse[..., 0, 0]


def _lines(ridge: _Ridge, radius: int) -> Iterator[_Ridge]:
    """Yield the points of a ridge that hang together, in their order."""
    for way in ways(ridge.place, _LINKED * radius, _LEAST_LENGTH * radius):
        yield _on_one_side(ridge.where(way), radius)


def _on_one_side(line: _Ridge, radius: int) -> _Ridge:
    """Return a line with its normals to the left of the way along it."""
    last = len(line.place) - 1
    ahead, behind = (np.clip(np.arange(last + 1) + step, 0, last) for step in (radius, -radius))
    along = line.place[ahead] - line.place[behind]
    turned = line.normal[:, 0] * along[:, 1] < line.normal[:, 1] * along[:, 0]
    sign = np.where(turned, -1.0, 1.0)[:, None]
    side, slope = (
        np.where(turned[:, None, None], values[:, ::-1], values) for values in (line.side, line.slope)
    )
    return replace(
        line, normal=sign * line.normal, side=side, slope=sign[:, :, None] * slope, jump=sign * line.jump
    )


def _even(line: _Ridge, radius: int) -> _Ridge:
    """Return a line by points that are a pixel apart, and smooth."""
    way = way_along(line.place)

    def smooth(values: Floats, width: float) -> Floats:
        return evened(values, way, width)

    place = smooth(line.place, 0.5 * radius)
    along = np.gradient(smooth(line.place, radius), axis=0)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    side, slope, jump, variance = (
        smooth(values, radius) for values in (line.side, line.slope, line.jump, line.variance)
    )
    return _Ridge(place, normal, side, slope, jump, variance)


def _settled(line: _Ridge, images: PreparedImages, displacement: Floats, radius: int) -> _Ridge | None:
    """Return a line moved to where the images change from one side to the other; None where they do not.

    In a strip along the line each pixel is looked up where each of the sides would have it, and where it is
    told to be. The line comes to where the sides leave least. Where a surface only bends, what is known of it
    leaves far less.
    """
    offset = np.arange(-radius, radius + 1.0)
    place = line.place[:, None] + offset[:, None] * line.normal[:, None]
    row, column = np.rint(place).astype(int).transpose(2, 0, 1)
    inside = (row >= 0) & (row < displacement.shape[1]) & (column >= 0) & (column < displacement.shape[2])
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    f = images.reference[row, column]
    told = displacement[:, row, column].transpose(1, 2, 0)
    sides = [line.side[:, None, k] + offset[:, None] * line.slope[:, None, k] for k in (0, 1)]
    near = [offset < -1.0, offset > 1.0, np.abs(offset) > 1.0]
    coefficients = ndimage.spline_filter(images.deformed, order=3)
    left = np.empty((3, *f.shape))
    everywhere = inside
    for number, (moved, own) in enumerate(zip((*sides, told), near, strict=True)):
        at = np.stack([row + moved[..., 1], column + moved[..., 0]])
        usable = inside & np.isfinite(at).all(axis=0)
        g = ndimage.map_coordinates(
            coefficients, np.where(usable, at, 0.0), order=3, prefilter=False, mode="nearest"
        )
        left[number] = _left_over(f, g, usable, own, radius)
        everywhere = everywhere & usable
    # What the crack itself shows is neither side's.
    left = np.where(everywhere, np.minimum(left, _OTHER**2 * np.median(left[2])), 0.0)
    cost = np.cumsum(left[0] - left[1], axis=1)
    cost = ndimage.gaussian_filter1d(cost, 0.3 * radius, axis=0, mode="nearest")
    best = np.argmin(np.where(np.abs(offset) <= 0.5 * radius, cost, np.inf), axis=1)
    best = ndimage.median_filter(best, size=radius, mode="nearest")
    behind = np.arange(len(offset)) <= best[:, None]
    if np.where(behind, left[0], left[1]).sum() > _AS_GOOD * left[2].sum():
        return None
    return replace(line, place=line.place + (offset[best] + 0.5)[:, None] * line.normal)


def _left_over(f: Floats, g: Floats, usable: Mask, own: Mask, radius: int) -> Floats:
    """Return (f - a - b g)^2 of a strip (n, across), a and b as its `own` columns have them."""
    weight = (usable & own).astype(np.float64)

    def mean(values: Floats) -> Floats:
        sums = ndimage.gaussian_filter1d((weight * values).sum(axis=1), radius, mode="nearest")
        return np.asarray(sums[:, None])

    total = np.maximum(mean(np.ones_like(f)), 1e-9)
    f, g = f - mean(f) / total, g - mean(g) / total
    gg = np.maximum(mean(g * g), 1e-12)
    return np.where(usable, (f - mean(f * g) / gg * g) ** 2, 0.0)


def _least_jump(pixels: int, radius: int) -> float:
    """Return from how many standard errors on a jump is no chance, of u or v in either sense."""
    subsets = max(pixels / (2.0 * radius + 1.0) ** 2, 1.0)
    return NormalDist().inv_cdf(1.0 - _BY_CHANCE / (4.0 * subsets))


def _jumps(line: _Ridge, radius: int, least: float) -> bool:
    """Tell whether the sides of a line lead to displacements of it that differ by `least` standard errors."""
    length = float(way_along(line.place)[-1])
    # Errors go together over a subset.
    error = np.sqrt(line.variance.mean(axis=0) / max(length / (2.0 * radius), 1.0))
    jump = np.abs(line.jump.mean(axis=0))
    return bool(np.any((jump > least * error) & (jump > _LEAST_JUMP_PX)))


@dataclass(frozen=True)
class _Tip:
    """An end of a line: which, its place and the direction in which it leads on, as row and column."""

    line: int
    place: Floats
    ahead: Floats

    @classmethod
    def of(cls, line: int, places: Floats, radius: int) -> _Tip:
        """Return the end at the last of the places of a line."""
        return cls(line, places[-1], course(places, np.ones(1), radius).ahead[0])

    def faces(self, other: _Tip) -> bool:
        """Tell whether the way to another tip goes ahead from this one."""
        way = other.place - self.place
        return bool(self.ahead @ way > _FACING * np.linalg.norm(way))


def _drawn(lines: list[_Ridge], told: Mask, radius: int) -> Mask:
    """Return the pixels of lines that are led on, to tips that they face or to where what is told of ends."""
    import cv2

    drawn = np.zeros(told.shape, dtype=np.uint8)

    def draw(places: Floats) -> None:
        cv2.polylines(drawn, [np.rint(places[:, ::-1]).astype(np.int32)], False, 1, thickness=_THICK)

    tips = []
    for number, line in enumerate(lines):
        draw(line.place)
        tips += [_Tip.of(number, places, radius) for places in (line.place, line.place[::-1])]
    facing = [
        (one, other)
        for one, other in combinations(tips, 2)
        if one.line != other.line and one.faces(other) and other.faces(one)
    ]
    joined: list[_Tip] = []
    for one, other in sorted(facing, key=lambda pair: float(np.linalg.norm(pair[0].place - pair[1].place))):
        if not any(tip is one or tip is other for tip in joined):
            joined += [one, other]
            draw(np.stack([one.place, other.place]))
    for tip in tips:
        if not any(tip is one for one in joined):
            others = [line.place for number, line in enumerate(lines) if number != tip.line]
            draw(_led_on(tip, told, KDTree(np.concatenate(others)) if others else None, radius))
    return drawn.astype(bool) & told


def _led_on(tip: _Tip, told: Mask, others: KDTree | None, radius: int) -> Floats:
    """Return the way straight on from a tip (n, 2), to another line or to where nothing is known of."""
    place = tip.place.copy()
    while True:
        place += tip.ahead
        row, column = np.rint(place).astype(int)
        if not (0 <= row < told.shape[0] and 0 <= column < told.shape[1] and told[row, column]):
            return np.stack([tip.place, place])
        if others is not None:
            distance, nearest = others.query(place)
            if distance <= radius:
                return np.stack([tip.place, place, others.data[nearest]])
