"""Pixels that see two surfaces: their point lies between the two, on neither.

Where the step between the surfaces is less than half a fringe, the phases of a mixed pixel are as
proportional to the density as those of a good one, and no residual tells it. Its neighbours do: planes that
are fitted to them on either side of it miss its point, one from the front and one from behind. Inverse depth
is used throughout, which is linear over the image of a plane.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask, Singles
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics

Pixel: TypeAlias = tuple[int, int]
Limits: TypeAlias = tuple[float, float]

_NEAR = 2.4  # standard deviations off a plane, both uncertainties together
_BEND = 0.3  # footprints off a plane that a bent surface may be: a radius of 15 footprints, 3 px away
_ROUGH = 3.0  # chi-square over its degrees of freedom, 6: seldom more of a plane, often of an edge
_LEAST = 6  # of the nine pixels that tell a plane
_LEAST_SURE = 6.0  # deviations of the pixel that is judged: what is worse known would hold anything
_CURVES = (1.0, 0.0, 0.0)  # of what two planes differ by: what they may miss a point by, in each round
_CURVED = 0.1  # of what a side's planes differ by: what a limb is off their parabola, by trial on 14 balls
_AXES = ((0, 1), (1, 0), (1, 1), (1, -1))  # (down, right)
_REACH = (2, 3)  # px to the middle of a plane: planes of 3 x 3 px that leave the pixel itself out
_SPAN = 4  # px from which planes are told
_STEP = 2.0 * _NEAR * sqrt(1.0 + 29.0 / 18.0)  # deviations; 29/18 is the variance of the farther plane, below
_JUMPS = 15  # the bits of all axes
_FOLD = 10.0  # deviations: of a fold that noise hides a spot of half a pixel takes off less than two
_AT_ONCE = 1.0 / 3.0
_HOLDS = 3
_BESIDE = np.ones((3, 3), np.uint8)

_NOTHING, _HELD, _ALONE, _BETWEEN = range(4)
"""Of a pixel along an axis: too few planes to tell; one of them holds it; both of one side miss it, and those
of the other miss it from the same side or are not there; it lies between those of both sides."""


@inner
@uncounted_kernel
def _plane(
    inverse: Floats, sigma: Floats, row: int, column: int, down: int, right: int, rough: float, at: Floats
) -> bool:
    """Fit a plane to the 3 x 3 px about (row + down, column + right), and follow it to (row, column).

    Its value there and the variance of that are written to `at`; `at[2]` is what a bend may add to the
    variance. `at[3]` is written: how many times the squared distances are as large as the variances say.
    False where there is no plane: too few pixels, or squares more than `rough` times as large, as of an edge.
    """
    top, left = row + down - 1, column + right - 1
    if top < 0 or left < 0 or top + 3 > inverse.shape[0] or left + 3 > inverse.shape[1]:
        return False
    here, least_sure = inverse[row, column], _LEAST_SURE * sigma[row, column]
    n, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sv, sxv, syv, svv, variance = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        for j in range(3):
            x, y, v, s = j - 1.0, i - 1.0, inverse[top + i, left + j] - here, sigma[top + i, left + j]
            if np.isnan(v) or s > least_sure:
                continue
            n += 1.0
            sx += x
            sy += y
            sxx += x * x
            sxy += x * y
            syy += y * y
            sv += v
            sxv += x * v
            syv += y * v
            svv += v * v
            variance += s * s
    if n < _LEAST:
        return False
    variance /= n
    sxx -= sx * sx / n
    sxy -= sx * sy / n
    syy -= sy * sy / n
    sxv -= sx * sv / n
    syv -= sy * sv / n
    svv -= sv * sv / n
    area = sxx * syy - sxy * sxy
    p, q = (sxv * syy - syv * sxy) / area, (syv * sxx - sxv * sxy) / area
    left_over = (svv - p * sxv - q * syv) / (n - 3.0)
    x, y = -right - sx / n, -down - sy / n
    at[0] = here + sv / n + p * x + q * y
    at[1] = variance * (1.0 / n + (x * x * syy - 2.0 * x * y * sxy + y * y * sxx) / area)
    at[3] = max(left_over / variance, 1.0)
    return bool(left_over <= rough * variance + at[2])


@inner
@uncounted_kernel
def _mark_steps(
    inverse: Floats, sigma: Floats, row: int, footprint: float, stepped: NDArray[np.uint8]
) -> None:
    """Set bit a for pixels of a row that may lie on a jump along axis a, on a plane for one in 70.

    There lines through the pixels 2 and 4 px away on either side are a step apart, or one of them is missing.
    Each line has a variance of 5, so that two are as far apart by chance for one in 70. The farther planes,
    of 3 x 3 px and 3 px away, have 1 / 9 + 9 / 6: two that miss a point from either side are `_STEP` apart.

    Bit 4 + a is set where the surface folds along the axis: the slopes of both lines differ, by `_FOLD` of
    their deviation, which is that of a pixel, and a third of that happens within a pixel. Of a bend a sixth
    does, of a fold that a spot blurs about half.
    """
    columns = stepped.size
    stepped[:] = _JUMPS
    if row < _SPAN or row >= inverse.shape[0] - _SPAN or columns <= 2 * _SPAN:
        return
    inner = columns - 2 * _SPAN
    own, inside = inverse[row, _SPAN : columns - _SPAN], stepped[_SPAN : columns - _SPAN]
    deviation = sigma[row, _SPAN : columns - _SPAN]
    inside[:] = 0
    for axis, (down, right) in enumerate(_AXES):
        a, b, c, d = _SPAN - 4 * right, _SPAN - 2 * right, _SPAN + 2 * right, _SPAN + 4 * right
        first, second = inverse[row - 4 * down, a : a + inner], inverse[row - 2 * down, b : b + inner]
        third, fourth = inverse[row + 2 * down, c : c + inner], inverse[row + 4 * down, d : d + inner]
        e, f = _SPAN - right, _SPAN + right
        before, after = inverse[row - down, e : e + inner], inverse[row + down, f : f + inner]
        bit, fold = np.uint8(1 << axis), np.uint8(16 << axis)
        for j in range(inner):
            bend = _BEND * footprint * own[j]
            apart = abs((2.0 * second[j] - first[j]) - (2.0 * third[j] - fourth[j]))
            turned = abs(0.5 * (first[j] - second[j] - third[j] + fourth[j]))
            inside[j] |= np.uint8(0) if apart < _STEP * deviation[j] + bend else bit
            here = abs(before[j] - 2.0 * own[j] + after[j])
            folded = turned > _FOLD * deviation[j] + bend and here > _AT_ONCE * turned
            inside[j] |= fold if folded else np.uint8(0)


@inner
@uncounted_kernel
def _missed(
    inverse: Floats, sigma: Floats, pixel: Pixel, down: int, right: int, limits: Limits, at: Floats
) -> int:
    """Return what the planes in a direction say of a pixel, 2 and 3 px away.

    How many of them miss it, negative where it lies behind; 0 where there is none, 3 where one holds it.
    """
    row, column = pixel
    bend, curve = limits
    here, own = inverse[row, column], sigma[row, column]
    count, first, first_limit, off = 0, 0.0, 0.0, 0.0
    for reach in _REACH:
        if not _plane(inverse, sigma, row, column, reach * down, reach * right, _ROUGH, at):
            continue
        off, limit = here - at[0], sqrt(_NEAR * _NEAR * (at[1] + own * own) + bend * bend)
        part = curve * abs(off - first) if count else 0.0
        if abs(off) <= limit + part or (count and abs(first) <= first_limit + part):
            return _HOLDS
        count, first, first_limit = count + 1, off, limit
    return count if off > 0.0 else -count


@inner
@uncounted_kernel
def _within(inverse: Floats, pixel: Pixel, down: int, right: int) -> bool:
    """Return whether the image goes on along an axis as far as planes may reach."""
    row, column = pixel
    r, c = _SPAN * down, _SPAN * abs(right)
    return bool(r <= row < inverse.shape[0] - r and c <= column < inverse.shape[1] - c)


@inner
@uncounted_kernel
def _along(
    inverse: Floats, sigma: Floats, pixel: Pixel, down: int, right: int, limits: Limits, at: Floats
) -> int:
    """Return what the planes along an axis say of a pixel: `_NOTHING`, `_HELD`, `_ALONE` or `_BETWEEN`."""
    before = _missed(inverse, sigma, pixel, -down, -right, limits, at)
    after = _missed(inverse, sigma, pixel, down, right, limits, at) if before != _HOLDS else _HOLDS
    if after == _HOLDS:
        return _HELD
    if before * after < 0:
        return _BETWEEN
    return (
        _ALONE
        if _within(inverse, pixel, down, right) and max(abs(before), abs(after)) == len(_REACH)
        else _NOTHING
    )


@inner
@uncounted_kernel
def _is_mixed(inverse: Floats, sigma: Floats, pixel: Pixel, stepped: int, limits: Limits, at: Floats) -> bool:
    """Return whether a pixel lies between surfaces along a stepped axis, or alone and not held along two."""
    alone, holding = False, 0
    for axis, (down, right) in enumerate(_AXES):
        if stepped >> axis & 1:
            said = _along(inverse, sigma, pixel, down, right, limits, at)
            if said == _BETWEEN:
                return True
            alone = alone or said == _ALONE
            holding += 1 if said == _HELD else 0
    if not alone:
        return False
    for axis, (down, right) in enumerate(_AXES):
        if not stepped >> axis & 1 and holding < 2:
            said = _along(inverse, sigma, pixel, down, right, limits, at)
            holding += 1 if said == _HELD else 0
    return holding < 2


@kernel
def _mixed_rows(
    inverse: Floats,
    sigma: Floats,
    asked: Mask,
    footprint: float,
    curve: float,
    start: int,
    stop: int,
    mixed: Mask,
) -> None:
    at, stepped = np.empty(4), np.empty(inverse.shape[1], np.uint8)
    for row in range(start, stop):
        if not asked[row].any():
            continue
        _mark_steps(inverse, sigma, row, footprint, stepped)
        for column in range(inverse.shape[1]):
            if stepped[column] & _JUMPS and asked[row, column]:
                bend = _BEND * footprint * inverse[row, column]
                at[2] = 0.25 * bend * bend
                pixel, limits = (row, column), (bend, curve)
                mixed[row, column] = _is_mixed(inverse, sigma, pixel, stepped[column], limits, at)


@inner
@uncounted_kernel
def _excess(
    inverse: Floats,
    sigma: Floats,
    pixel: Pixel,
    down: int,
    right: int,
    bend: float,
    folded: bool,
    at: Floats,
) -> float:
    """Return the variance that a pixel is off what an axis says by, beyond what noise explains.

    The planes of either side say it, and the two of one side together: a bend makes the farther one miss by
    9/4 of what the nearer one does, light of another surface by the same, so that 9/5 of the one less 4/5 of
    the other is what is no bend, but for a tenth of their difference at a limb. They share six pixels and
    thereby 1/6 of the nearer one's variance. What explains most counts. A side without a farther plane tells
    nothing. Sides that agree are of one surface: it is 0, unless that is folded there. Past the image nothing
    is known: it is 0, too.
    """
    if not _within(inverse, pixel, down, right):
        return 0.0
    row, column = pixel
    here, own = inverse[row, column], sigma[row, column] ** 2
    least, before, before_variance = np.inf, np.nan, 0.0
    closer, farther = _REACH
    for side in (-1, 1):
        i, j = side * down, side * right
        if not _plane(inverse, sigma, row, column, closer * i, closer * j, np.inf, at):
            continue
        near, near_variance = here - at[0], at[1] * at[3]
        agreed = (near - before) ** 2 <= _NEAR**2 * (near_variance + before_variance) + bend**2
        if agreed and not folded:
            return 0.0
        before, before_variance = near, near_variance
        if not _plane(inverse, sigma, row, column, farther * i, farther * j, np.inf, at):
            continue
        far, far_variance = here - at[0], at[1] * at[3]
        shared = near_variance / 6.0
        bent = sqrt(max((far - near) ** 2 - near_variance - far_variance + 2.0 * shared, 0.0))
        straight = max(abs(1.8 * near - 0.8 * far) - _CURVED * bent, 0.0)
        of_both = 1.8**2 * near_variance + 0.8**2 * far_variance - 2.0 * 1.8 * 0.8 * shared
        least = min(least, near**2 - near_variance, far**2 - far_variance, straight**2 - of_both)
    return max(least - own, 0.0) if least < np.inf else 0.0


@kernel
def _excess_rows(
    inverse: Floats, sigma: Floats, asked: Mask, footprint: float, start: int, stop: int, variance: Floats
) -> None:
    at, stepped = np.empty(4), np.empty(inverse.shape[1], np.uint8)
    for row in range(start, stop):
        if not asked[row].any():
            continue
        _mark_steps(inverse, sigma, row, footprint, stepped)
        for column in range(inverse.shape[1]):
            if stepped[column] and asked[row, column]:
                bend = _BEND * footprint * inverse[row, column]
                at[2] = 0.25 * bend * bend
                for axis, (down, right) in enumerate(_AXES):
                    folded = bool(stepped[column] >> 4 + axis & 1)
                    if folded or stepped[column] >> axis & 1:
                        found = _excess(inverse, sigma, (row, column), down, right, bend, folded, at)
                        variance[row, column] = max(variance[row, column], found)


@dataclass(frozen=True)
class InverseDepths:
    """Points as a camera sees them.

    Attributes
    ----------
    inverse, sigma
        (rows, columns) in 1/mm: inverse depths, NaN where nothing is known, and their standard deviations.
    footprint
        What a pixel sees of a surface at a depth of 1, across the ray.
    """

    inverse: Floats
    sigma: Floats
    footprint: float

    def without(self, lost: Mask) -> InverseDepths:
        """Return them with some pixels not known."""
        return replace(self, inverse=np.where(lost, np.nan, self.inverse))


def inverse_depths(
    xyz: Floats, covariance: Singles, known: Mask, intrinsics: Intrinsics, pose: Pose
) -> InverseDepths:
    """Return the inverse depths of the known points.

    Parameters
    ----------
    xyz, covariance
        (3, rows, columns) in mm and (6, rows, columns) in mm^2, of the points, in the world.
    known
        (rows, columns).
    intrinsics, pose
        Of the camera.
    """
    depth = np.tensordot(pose.matrix()[2], xyz, axes=1) + pose.translation[2]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        inverse = np.where(known, 1.0 / depth, np.nan)
        sigma = np.sqrt(covariance[0] + covariance[3] + covariance[5]) * inverse**2
    return InverseDepths(inverse, sigma, 1.0 / sqrt(intrinsics.fx * intrinsics.fy))


def between_surfaces(seen: InverseDepths, asked: Mask, threads: int = 1) -> Mask:
    """Find the pixels whose point lies between two surfaces, beside a jump, and on neither.

    Parameters
    ----------
    seen
        What tells where the surfaces are.
    asked
        (rows, columns): which are to be judged.
    threads
        Number of threads; the result does not depend on it.

    Returns
    -------
    (rows, columns): these pixels.

    Notes
    -----
    Planes of 3 x 3 px, 2 and 3 px away in eight directions, hold a point that is off them by 2.4 standard
    deviations of both and 0.3 footprints of a pixel, or by as much as they differ there: on a bent
    surface the farther one misses a point by 9/4 of what the nearer one does. A point is mixed where the
    planes of two opposite directions miss it from either side, whatever others say, because along the
    edge its neighbours are mixed as it is. It is mixed too where both of one direction miss it, those of
    the opposite one miss it from the same side or are not there, and no two axes hold it: where the phase
    of a pixel is known to a fringe alone, it may lie before or behind both surfaces. What has been found
    is left out of the planes, and its neighbours are judged twice more without allowance for a bend. At a
    crease the planes of its own side hold a point.

    In front of a wall, a ball with a radius of 30 footprints is lost where it is steeper than about 60
    degrees, one of 15 where it is steeper than 50: there it falls away as mixed pixels do.
    """
    import cv2

    inverse, mixed, left = seen.inverse.copy(), np.zeros(asked.shape, np.bool_), asked
    for curve in _CURVES:
        found = np.zeros(asked.shape, np.bool_)

        def work(start: int, stop: int, curve: float = curve, left: Mask = left, found: Mask = found) -> None:
            _mixed_rows(inverse, seen.sigma, left, seen.footprint, curve, start, stop, found)

        in_row_blocks(work, len(asked), threads)
        mixed |= found
        inverse[found] = np.nan
        left = asked & ~mixed & (cv2.dilate(mixed.astype(np.uint8), _BESIDE) > 0)
    return mixed


def beyond_noise(seen: InverseDepths, asked: Mask, threads: int = 1) -> Floats:
    """Return by how much points beside a jump or on a fold are off the nearest plane beyond noise.

    That is light of the other surface, too little to be told; the bend of a limb within a pixel; or what a
    spot takes off a fold, which is higher or lower than both of its faces say. The arguments are those of
    `between_surfaces`, without the pixels that it finds.

    Returns
    -------
    (rows, columns) in 1/mm; 0 elsewhere.
    """
    variance = np.zeros(asked.shape)

    def measure(start: int, stop: int) -> None:
        _excess_rows(seen.inverse, seen.sigma, asked, seen.footprint, start, stop, variance)

    in_row_blocks(measure, len(asked), threads)
    return np.sqrt(variance)
