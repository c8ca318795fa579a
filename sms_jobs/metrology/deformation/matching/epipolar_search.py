"""First guesses of matches between cameras: along the ray's image, with the subset as a plane would look.

Nobody has to say how far to look: a point of the measurement volume is seen by a partner somewhere along the
image of the reference camera's ray, and what two views of a small piece of surface differ by is known for
each place and orientation of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.compilation import in_row_blocks, inlined, inner, kernel, uncounted_summing_kernel
from sms_jobs.metrology.deformation.matching.seeding import block_means
from sms_jobs.metrology.geometry.camera import Camera
from sms_jobs.metrology.geometry.several_cameras import depths_in_box, plane_warps, points_along_rays

Corner: TypeAlias = tuple[float, float, float]
Width: TypeAlias = Callable[[Floats], Floats]
"""How far off the images of their rays points (n, 3) in mm may be seen, (n,) in px."""

_BIN = 2  # px of the images in one of those that are searched
_NEXT = np.uint64(1)
_ROUNDING = 1e-6  # px: corners and pixels are computed in other orders
_MOST_PLACES = 4096  # along a ray
_MOST_BESIDE = 100.0  # px: who knows so little calibrates again
_AT_ONCE = 64  # squares, for the memory's sake
_LEAST_OVERLAP = 0.6  # part of a template that must meet the partner's image
_UPRIGHT = (0.0, 0.0)
_TILTS = tuple((np.tan(0.6) * np.cos(a), np.tan(0.6) * np.sin(a)) for a in np.arange(6) * np.pi / 3.0)
"""Slopes of surfaces that are tried where one that faces the cameras fits nowhere."""
_APART = 6  # steps from the best place from which on another is another one
_UNIQUE = 0.08  # correlation by which the best place must exceed any other


@dataclass(frozen=True)
class FoundSeeds:
    """What the search found at n points.

    Attributes
    ----------
    warp
        (n, 6), from the reference image to the partner's: u, du/dx, du/dy, v, dv/dx, dv/dy, in px.
    score
        (n,), correlation there; -1 where there is none.
    runner_up
        (n,), the best correlation elsewhere along the ray.
    """

    warp: Floats
    score: Floats
    runner_up: Floats

    @classmethod
    def none(cls, count: int) -> FoundSeeds:
        """Return room for `count` points, of which none has been found."""
        return cls(np.full((count, 6), np.nan), np.full(count, -1.0), np.full(count, -1.0))

    def only(self, points: NDArray[np.intp]) -> FoundSeeds:
        """Return what was found at some of the points."""
        return FoundSeeds(*(values[points] for values in vars(self).values()))

    def enter(self, points: NDArray[np.intp], found: FoundSeeds) -> None:
        """Enter what was found for some of the points."""
        for mine, theirs in zip(vars(self).values(), vars(found).values(), strict=True):
            mine[points] = theirs

    @property
    def unique(self) -> Mask:
        """(n,): whether no other place is about as good."""
        return np.asarray(self.score > self.runner_up + _UNIQUE)


@inlined
def _grey_level(image: Floats, x: float, y: float) -> float:
    """Return the grey level at a place between four pixels of an image, by linear interpolation."""
    column, row = np.int64(x), np.int64(y)
    s, t = x - column, y - row
    # Unsigned indices need no look at their sign: several places are then done at a time.
    c, r = np.uint64(column), np.uint64(row)
    upper = image[r, c] + s * (image[r, c + _NEXT] - image[r, c])
    lower = image[r + _NEXT, c] + s * (image[r + _NEXT, c + _NEXT] - image[r + _NEXT, c])
    return float(upper + t * (lower - upper))


@inner
@uncounted_summing_kernel
def _sums_of_whole(
    template: Floats, image: Floats, x: float, y: float, place: Floats, slope: Floats, half: int
) -> tuple[float, float, float, float, float]:
    """Return the sums of f, g, f^2, g^2 and f g over a square, all of which both images show."""
    sf, sg, sff, sgg, sfg = 0.0, 0.0, 0.0, 0.0, 0.0
    left, top = int(np.rint(x)) - half, int(np.rint(y)) - half
    for j in range(2 * half + 1):
        dy = top + j - y
        for i in range(2 * half + 1):
            dx = left + i - x
            px = place[0] + slope[0, 0] * dx + slope[0, 1] * dy
            py = place[1] + slope[1, 0] * dx + slope[1, 1] * dy
            g = _grey_level(image, px, py)
            f = template[np.uint64(top + j), np.uint64(left + i)]
            sf += f
            sg += g
            sff += f * f
            sgg += g * g
            sfg += f * g
    return sf, sg, sff, sgg, sfg


@inlined
def _sees_all(
    template: Floats, image: Floats, x: float, y: float, place: Floats, slope: Floats, half: int
) -> bool:
    """Return whether both images hold a square about (x, y) and its image about a place, with its corners."""
    rows, columns = image.shape
    cx, cy = int(np.rint(x)), int(np.rint(y))
    wide, high = half + abs(cx - x), half + abs(cy - y)
    right = wide * abs(slope[0, 0]) + high * abs(slope[0, 1]) + _ROUNDING
    down = wide * abs(slope[1, 0]) + high * abs(slope[1, 1]) + _ROUNDING
    own = cx >= half and cy >= half and cx + half < template.shape[1] and cy + half < template.shape[0]
    # Written so that NaN is outside.
    along = place[0] >= right and place[0] + right < columns - 1
    return own and along and place[1] >= down and place[1] + down < rows - 1


@inner
@kernel
def _sums_of_part(
    template: Floats, image: Floats, x: float, y: float, place: Floats, slope: Floats, half: int
) -> tuple[int, int, float, float, float, float, float]:
    """Return how many of a square's pixels the first image shows, and both, and the sums over the latter."""
    rows, columns = image.shape
    n = 0
    sf, sg, sff, sgg, sfg = 0.0, 0.0, 0.0, 0.0, 0.0
    cx, cy = int(np.rint(x)), int(np.rint(y))
    whole = 0
    for j in range(-half, half + 1):
        if cy + j < 0 or cy + j >= template.shape[0]:
            continue
        for i in range(-half, half + 1):
            if cx + i < 0 or cx + i >= template.shape[1]:
                continue
            whole += 1
            dx, dy = cx + i - x, cy + j - y
            px = place[0] + slope[0, 0] * dx + slope[0, 1] * dy
            py = place[1] + slope[1, 0] * dx + slope[1, 1] * dy
            if not (px >= 0.0 and py >= 0.0 and px < columns - 1 and py < rows - 1):
                continue
            g = _grey_level(image, px, py)
            f = template[cy + j, cx + i]
            n += 1
            sf += f
            sg += g
            sff += f * f
            sgg += g * g
            sfg += f * g
    return whole, n, sf, sg, sff, sgg, sfg


@inner
@kernel
def _score(
    template: Floats, image: Floats, x: float, y: float, place: Floats, slope: Floats, half: int
) -> float:
    """Return the correlation of the square about (x, y) with its image about a place; -1 where it is cut."""
    if _sees_all(template, image, x, y, place, slope, half):
        whole = n = (2 * half + 1) ** 2
        sf, sg, sff, sgg, sfg = _sums_of_whole(template, image, x, y, place, slope, half)
    else:
        whole, n, sf, sg, sff, sgg, sfg = _sums_of_part(template, image, x, y, place, slope, half)
    if whole == 0 or n < _LEAST_OVERLAP * whole:
        return -1.0
    ff, gg = sff - sf * sf / n, sgg - sg * sg / n
    if not (ff > 1e-9 * sff and gg > 1e-9 * sgg):
        return -1.0
    return float((sfg - sf * sg / n) / np.sqrt(ff * gg))


@kernel
def _search_block(
    start: int, stop: int, template: Floats, image: Floats, pixels: Floats, places: Floats, slopes: Floats,
    half: int, widths: Ints,
    best: Floats, found: Ints, met: Floats, runner_up: Floats,
) -> None:  # fmt: skip
    """Fill for points start .. stop the best score, beside which place, where, and the best elsewhere."""
    many = places.shape[1]
    along = np.empty(many)
    beside = np.empty((many, 2))
    place = np.empty(2)
    for i in range(start, stop):
        for m in range(many):
            along[m] = -1.0
            if not np.isfinite(places[i, m, 0]):
                continue
            # Across the ray's image: the direction from one place to the next, turned.
            n = m + 1 if m + 1 < many and np.isfinite(places[i, m + 1, 0]) else m - 1
            if n < 0 or not np.isfinite(places[i, n, 0]):
                continue
            ax, ay = places[i, n, 1] - places[i, m, 1], places[i, m, 0] - places[i, n, 0]
            length = np.sqrt(ax * ax + ay * ay)
            if not length > 0.0:
                continue
            for k in range(-widths[i], widths[i] + 1):
                place[0] = places[i, m, 0] + k * ax / length
                place[1] = places[i, m, 1] + k * ay / length
                score = _score(template, image, pixels[i, 0], pixels[i, 1], place, slopes[i, m], half)
                if score > along[m]:
                    along[m] = score
                    beside[m] = place
        top = int(np.argmax(along))
        best[i], found[i] = along[top], top
        met[i] = beside[top]
        for m in range(many):
            if abs(m - top) > _APART and along[m] > runner_up[i]:
                runner_up[i] = along[m]


def search_along_rays(
    reference: Camera,
    partner: Camera,
    images: tuple[NDArray[np.floating], NDArray[np.floating]],
    pixels: Floats,
    volume: tuple[Corner, Corner],
    *,
    radius: int,
    width: Width,
    tilted: bool = False,
    threads: int = 1,
) -> FoundSeeds:
    """Find where a partner sees the squares about some pixels of the reference camera, to about a pixel.

    Parameters
    ----------
    images
        Of the reference camera and of the partner, (rows, columns), in grey levels.
    pixels
        (n, 2), x and y in the reference image.
    volume
        Two corners of the box in mm that the points lie in.
    radius
        Half the side of the squares, in px.
    width
        How far off the ray's image to look: what the calibration may be wrong by. The largest value at both
        ends and in the middle of a ray counts, but at least a step of the search, 2 px, and at most 100 px.
    tilted
        Whether the squares are taken for pieces of surface that are tilted by 34 degrees, in six directions,
        rather than for such that face the cameras: six times the work.
    threads
        How many threads to use; the result does not depend on it.
    """
    rays, near, far = depths_in_box(reference, pixels, *volume)
    coarse = tuple(block_means(np.asarray(image, dtype=np.float64), _BIN) for image in images)
    widths = _steps_beside(points_along_rays(reference, rays, near, far, 3), width)
    middle = 0.5 * (reference.pose.centre() + partner.pose.centre())

    def search(points: NDArray[np.intp], tilt: tuple[float, float]) -> FoundSeeds:
        found = FoundSeeds.none(len(pixels))
        for some in np.split(points, range(_AT_ONCE, len(points), _AT_ONCE)):
            depths = (rays[some], near[some], far[some])
            found.enter(some, _with_tilt(
                reference, partner, coarse, pixels[some], depths, middle, tilt, radius, widths[some], threads
            ))  # fmt: skip
        return found

    met = np.flatnonzero(np.isfinite(near))
    return best_of([search(met, tilt) for tilt in (_TILTS if tilted else (_UPRIGHT,))])


def _steps_beside(points: Floats, width: Width) -> Ints:
    """Return how many steps beside rays' images to look, (n,), by what is known at points (n, m, 3)."""
    wide = width(np.nan_to_num(points).reshape(-1, 3)).reshape(points.shape[:2])
    widest = np.fmax.reduce(np.where(np.isfinite(points[..., 0]), wide, 0.0), axis=1, initial=0.0)
    return np.asarray(np.maximum(np.ceil(np.minimum(widest, _MOST_BESIDE) / _BIN), 1.0), dtype=np.int64)


def best_of(tried: list[FoundSeeds]) -> FoundSeeds:
    """Return what fits best; what another tilt explains at the same place is no rival, elsewhere it is."""
    warp = np.stack([one.warp for one in tried])
    score, runner_up = (np.stack([getattr(one, name) for one in tried]) for name in ("score", "runner_up"))
    best, each = np.argmax(score, axis=0), np.arange(warp.shape[1])
    chosen = warp[best, each]
    away = np.hypot(warp[..., 0] - chosen[:, 0], warp[..., 3] - chosen[:, 3]) > _APART * _BIN
    return FoundSeeds(chosen, score[best, each], np.where(away, score, runner_up).max(axis=0))


def _with_tilt(
    reference: Camera,
    partner: Camera,
    coarse: tuple[Floats, ...],
    pixels: Floats,
    depths: tuple[Floats, Floats, Floats],
    middle: Floats,
    tilt: tuple[float, float],
    radius: int,
    widths: Ints,
    threads: int,
) -> FoundSeeds:
    """Search for pieces of surface that are tilted by a slope against one that faces the cameras."""
    rays, near, far = depths
    centre = reference.pose.centre()
    count = len(pixels)
    ends = np.stack([centre + s[:, None] * rays for s in (near, far)], axis=1)
    seen, _ = plane_warps(reference, partner, pixels, ends, _facing(ends, middle, reference, tilt), radius)
    length = np.hypot(*np.moveaxis(seen[:, 1] - seen[:, 0], -1, 0))
    longest = np.nanmax(length, initial=0.0)
    diagonal = float(np.hypot(partner.columns, partner.rows))
    steps = int(np.clip(np.nan_to_num(longest, nan=2.0 * diagonal) / _BIN + 2, 3, _MOST_PLACES))
    points = points_along_rays(reference, rays, near, far, steps)
    places, slopes = plane_warps(
        reference, partner, pixels, points, _facing(points, middle, reference, tilt), float(radius)
    )
    outside = (
        (places < -radius).any(axis=-1)
        | (places[..., 0] > partner.columns + radius)
        | (places[..., 1] > partner.rows + radius)
    )
    places[outside] = np.nan
    # Pixel (0, 0) of a binned image is the middle of its square.
    shift = 0.5 * (_BIN - 1)
    own, there = (pixels - shift) / _BIN, (places - shift) / _BIN
    best, runner_up = np.full(count, -1.0), np.full(count, -1.0)
    found, met = np.zeros(count, dtype=np.int64), np.full((count, 2), np.nan)
    half = max(3, radius // _BIN)

    def work(start: int, stop: int) -> None:
        _search_block(
            start, stop, coarse[0], coarse[1], own, there, slopes, half, widths, best, found, met, runner_up
        )

    in_row_blocks(work, count, threads, block=4)
    place, slope = _BIN * met + shift, slopes[np.arange(count), found]
    warp = np.stack(
        [
            place[:, 0] - pixels[:, 0], slope[:, 0, 0] - 1.0, slope[:, 0, 1],
            place[:, 1] - pixels[:, 1], slope[:, 1, 0], slope[:, 1, 1] - 1.0,
        ],
        axis=1,
    )  # fmt: skip
    warp[best < 0.0] = np.nan
    return FoundSeeds(warp, best, runner_up)


def _facing(points: Floats, middle: Floats, reference: Camera, tilt: tuple[float, float]) -> Floats:
    """Return normals (n, m, 3) of surfaces at points that face the cameras' middle, tilted by two slopes."""
    towards = middle - points
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    if tilt == _UPRIGHT:
        return np.asarray(towards)
    right, down, _ = reference.pose.matrix()
    return np.asarray(towards + tilt[0] * right + tilt[1] * down)
