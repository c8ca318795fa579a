"""Where the ray of a reference camera's pixel is met by the rays of partners: the loops of `meet_rays`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.compilation import inlined, inner, kernel
from sms_jobs.metrology.geometry.lens_kernels import by_point, distorted, undistort_some
from sms_jobs.metrology.geometry.triangulation import closest, turned

_STEPS = 3
"""Of Gauss-Newton from the closest approach of two rays, at most; each squares what is left of hundredths of
a px."""
_STILL = 1e-3
"""Part of a depth's standard deviation that may be left to the next step: about this one's square over the
depth, since where a point is seen is linear in all unknowns but that."""
_SINGULAR = 1e-9
"""Part of what the images say of a depth that may be left beside what they say of the matches."""


@inlined
def _seen_from(turn: Floats, shift: Floats, lens: Floats, x: float, y: float, z: float, out: Floats) -> bool:
    """Fill out (2 + 6) with the pixel of a point of the world and its derivatives; say if it is in front."""
    a = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0]
    b = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1]
    depth = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2]
    if not depth > 0.0:
        return False
    p, q = a / depth, b / depth
    bent_p, bent_q = distorted(lens, p, q)
    out[0], out[1] = lens[0] * bent_p + lens[2], lens[1] * bent_q + lens[3]
    pp, pq, qp, qq = by_point(lens, p, q)
    for i in range(3):
        dp = (turn[0, i] - p * turn[2, i]) / depth
        dq = (turn[1, i] - q * turn[2, i]) / depth
        out[2 + i] = lens[0] * (pp * dp + pq * dq)
        out[5 + i] = lens[1] * (qp * dp + qq * dq)
    return True


@inlined
def _along(direction: tuple[float, float, float], seen: Floats, j: int) -> float:
    """Return the derivative along a direction of the number whose derivatives begin at `j` of `seen`."""
    return float(seen[j] * direction[0] + seen[j + 1] * direction[1] + seen[j + 2] * direction[2])


@inner
@kernel
def _first_depths(
    which: Ints, directions: Floats, centre: Floats, turns: Floats, pin_holes: Floats, lenses: Floats,
    places: Floats, depths: Floats, gap: Floats,
) -> None:  # fmt: skip
    """Fill in where the first partner's rays are nearest to the reference's, in units of those, and the gaps.

    `directions` (3, n) and `depths` (n,) are those of the pixels `which` (n,); NaN where there is none.
    """
    depths[:] = np.nan
    rays, wanted = np.empty((6, len(which))), np.empty(len(which), dtype=np.int64)
    for k in range(len(lenses)):
        count = 0
        for j in range(len(which)):
            if np.isnan(depths[j]) and np.isfinite(places[k, 0, which[j]]):
                wanted[count] = j
                count += 1
        undistort_some(lenses[k], places[k], which[wanted[:count]], rays[:, :count])
        base = (pin_holes[k, 0] - centre[0], pin_holes[k, 1] - centre[1], pin_holes[k, 2] - centre[2])
        for at in range(count):
            j = wanted[at]
            u = (directions[0, j], directions[1, j], directions[2, j])
            point, gap[which[j]] = closest(u, turned(turns[k], rays[0, at], rays[1, at], 1.0), base, 0.0)
            square = u[0] ** 2 + u[1] ** 2 + u[2] ** 2
            depths[j] = (point[0] * u[0] + point[1] * u[1] + point[2] * u[2]) / square


@inlined
def _place(
    direction: tuple[float, float, float], centre: Floats, depth: float, variance: float,
    along: tuple[float, float], xyz: Floats, covariance: Floats, by_own: Floats, i: int,
) -> None:  # fmt: skip
    """Fill in point i: where it lies, at a depth in units of a ray's direction, and its covariance.

    `along` is what the reference image's noise moves the depth by.
    """
    at = 0
    length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    by_own[0, i], by_own[1, i] = length * along[0], length * along[1]
    for m in range(3):
        xyz[m, i] = centre[m] + depth * direction[m]
        for n in range(m, 3):
            covariance[at, i] = variance * direction[m] * direction[n]
            at += 1


@inlined
def _is_seen(places: Floats, sigma: Floats, k: int, i: int) -> bool:
    return bool(np.isfinite(places[k, 0, i]) and sigma[k, 0, i] > 0.0 and sigma[k, 1, i] > 0.0)


@inner
@kernel
def _seen_by_any(start: int, stop: int, places: Floats, sigma: Floats) -> Ints:
    """Return which of the points start .. stop a partner sees."""
    which, count = np.empty(stop - start, dtype=np.int64), 0
    for i in range(start, stop):
        for k in range(len(places)):
            if _is_seen(places, sigma, k, i):
                which[count] = i
                count += 1
                break
    return which[:count]


@inlined
def _own_variance(places: Floats, sigma: Floats, i: int) -> tuple[int, float]:
    """Return how many partners see a point, and the reference image's part of a match's variance, px^2."""
    count, own = 0, 0.0
    for k in range(len(places)):
        if _is_seen(places, sigma, k, i):
            own += 0.25 * (sigma[k, 0, i] ** 2 + sigma[k, 1, i] ** 2)
            count += 1
    return count, own / max(count, 1)


@inlined
def _solved(
    aa: float, ab: float, az: float, bb: float, bz: float, zz: float, ra: float, rb: float, rz: float
) -> tuple[float, float, float, float]:
    """Solve normal equations in (a, b, depth), given by their upper triangle and their right side.

    The last number is the variance of the depth, NaN where they say nothing of it.
    """
    # The depth comes last, so that what is left of its diagonal is one over its variance.
    mixed, lever = ab / aa, az / aa
    left_b = bb - mixed * ab
    cross = bz - mixed * az
    other = cross / left_b
    left_z = zz - lever * az - other * cross
    variance = 1.0 / left_z if left_z > _SINGULAR * zz else np.nan
    rest_b = rb - mixed * ra
    step_z = (rz - lever * ra - other * rest_b) * variance
    step_b = rest_b / left_b - other * step_z
    return ra / aa - mixed * step_b - lever * step_z, step_b, step_z, variance


@inner
@kernel
def _settle_depths(
    which: Ints, rays: Floats, directions: Floats, depths: Floats, turn: Floats, centre: Floats,
    turns: Floats, shifts: Floats, lenses: Floats, places: Floats, sigma: Floats, slopes: Floats,
    seen: Floats, xyz: Floats, covariance: Floats, gap: Floats, chi_square: Floats,
    freedom: NDArray[np.int32], by_own: Floats,
) -> None:  # fmt: skip
    """Fill in the points of the pixels `which` (n,) by least squares in all images, from first depths on.

    Unknown are the depth and by how much, (a, b) in px, the reference camera's noise has moved the matches of
    all partners; each image has half of a match's variance. `seen` is room for 8 numbers.
    """
    for j in range(len(which)):
        i, depth = which[j], depths[j]
        count, own = _own_variance(places, sigma, i)
        d = (directions[0, j], directions[1, j], directions[2, j])
        across = turned(turn, rays[2, j], rays[4, j], 0.0)
        down = turned(turn, rays[3, j], rays[5, j], 0.0)
        a, b, chi, variance = 0.0, 0.0, np.nan, np.nan
        for _ in range(_STEPS):
            # Of the normal equations in (a, b, depth) the upper triangle and the right side.
            aa, ab, az, bb, bz, zz = 1.0 / own, 0.0, 0.0, 1.0 / own, 0.0, 0.0
            ra, rb, rz = -a / own, -b / own, 0.0
            chi = (a * a + b * b) / own
            for k in range(len(lenses)):
                if not _is_seen(places, sigma, k, i):
                    continue
                if not _seen_from(
                    turns[k], shifts[k], lenses[k],
                    centre[0] + depth * d[0], centre[1] + depth * d[1], centre[2] + depth * d[2], seen,
                ):  # fmt: skip
                    chi = np.nan
                    break
                for axis in range(2):
                    at = 2 + 3 * axis
                    by_z = _along(d, seen, at)
                    by_a, by_b = slopes[k, axis, 0, i], slopes[k, axis, 1, i]
                    if not (np.isfinite(by_a) and np.isfinite(by_b)):
                        by_a, by_b = depth * _along(across, seen, at), depth * _along(down, seen, at)
                    weight = 2.0 / sigma[k, axis, i] ** 2
                    off = places[k, axis, i] - seen[axis] - a * by_a - b * by_b
                    chi += weight * off * off
                    ra += weight * off * by_a
                    rb += weight * off * by_b
                    rz += weight * off * by_z
                    aa += weight * by_a * by_a
                    ab += weight * by_a * by_b
                    az += weight * by_a * by_z
                    bb += weight * by_b * by_b
                    bz += weight * by_b * by_z
                    zz += weight * by_z * by_z
            step_a, step_b, step_z, variance = _solved(aa, ab, az, bb, bz, zz, ra, rb, rz)
            if not (np.isfinite(chi) and variance > 0.0):
                chi = np.nan
                break
            a, b, depth = a + step_a, b + step_b, depth + step_z
            chi = max(chi - ra * step_a - rb * step_b - rz * step_z, 0.0)
            if step_z**2 < _STILL * np.sqrt(variance) * abs(depth):
                break
        if not (np.isfinite(chi) and depth > 0.0):
            gap[i] = np.nan
            continue
        chi_square[i], freedom[i] = chi, 2 * count - 1
        with_a, with_b, _, variance = _solved(aa, ab, az, bb, bz, zz, 0.0, 0.0, 1.0)
        _place(d, centre, depth, variance, (-with_a / own, -with_b / own), xyz, covariance, by_own, i)


@kernel
def meet_block(
    start: int, stop: int, reference: tuple[Floats, Floats, Floats], turns: Floats, shifts: Floats,
    pin_holes: Floats, lenses: Floats, pixels: Floats, places: Floats, sigma: Floats, slopes: Floats,
    xyz: Floats, covariance: Floats, gap: Floats, chi_square: Floats, freedom: NDArray[np.int32],
    by_own: Floats,
) -> None:  # fmt: skip
    """Do the work of `meet_rays` for points start .. stop."""
    turn, centre, lens = reference
    which, seen = _seen_by_any(start, stop, places, sigma), np.empty(8)
    rays, directions, depths = np.empty((6, len(which))), np.empty((3, len(which))), np.empty(len(which))
    undistort_some(lens, pixels, which, rays)
    for j in range(len(which)):
        directions[0, j], directions[1, j], directions[2, j] = turned(turn, rays[0, j], rays[1, j], 1.0)
    _first_depths(which, directions, centre, turns, pin_holes, lenses, places, depths, gap)
    _settle_depths(
        which, rays, directions, depths, turn, centre, turns, shifts, lenses, places, sigma, slopes, seen,
        xyz, covariance, gap, chi_square, freedom, by_own,
    )  # fmt: skip
