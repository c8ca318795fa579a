"""Points that several cameras see: on the ray of a reference camera, where all see them best.

The reference camera's pixel names the point, so the point lies on its ray and its depth alone is unknown; but
the match is between two noisy images, and what the reference camera's noise does to it is shared by all
partners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import in_row_blocks, inlined, kernel
from sms_jobs.metrology.geometry.camera import (
    Camera,
    project,
    projection_jacobian,
    ray_directions,
)
from sms_jobs.metrology.geometry.lens_kernels import by_point, distorted, undistorted
from sms_jobs.metrology.geometry.triangulation import closest, turned

_STEPS = 3
"""Of Gauss-Newton from the closest approach of two rays, at most; each squares what is left of hundredths of
a px."""
_STILL = 1e-3
"""Part of a depth's standard deviation that may be left to the next step: about this one's square over the
depth, since where a point is seen is linear in all unknowns but that."""
_SIDE = 16
"""Of squares in px over which epipolar lines are taken to have one direction."""
_SINGULAR = 1e-9
"""Part of what the images say of a depth that may be left beside what they say of the matches."""


@dataclass(frozen=True)
class SeenPoints:
    """Points of n pixels of a reference camera; NaN where no partner sees them, or behind a camera.

    Attributes
    ----------
    xyz
        (3, n) in mm, in the world's frame, on the reference camera's rays.
    covariance
        (6, n) in mm^2, packed XX, XY, XZ, YY, YZ, ZZ; of the matches alone.
    ray_gap
        (n,) in mm: distance of the reference camera's ray from that of the first partner that sees the point.
    chi_square
        (n,), what the rays miss each other by, squared in units of the matches' noise; for good matches and a
        perfect calibration it follows a chi-square law of 2 partners - 1 degrees of freedom.
    freedom
        (n,), those degrees of freedom.
    by_own
        (2, n) in mm / px: how far a point moves away from the reference camera, along its ray, where the
        noise of that camera's image moves the matches of all partners as if its pixel lay one px further
        along the columns, or the rows.
    """

    xyz: Floats
    covariance: Floats
    ray_gap: Floats
    chi_square: Floats
    freedom: NDArray[np.int32]
    by_own: Floats


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


@inlined
def _first_depth(
    direction: tuple[float, float, float],
    centre: Floats,
    turn: Floats,
    pin_hole: Floats,
    lens: Floats,
    place: Floats,
    inner: Floats,
) -> tuple[float, float]:
    """Return where a partner's ray is nearest to the reference's, in units of its direction, and the gap."""
    if not undistorted(lens, place, inner):
        return np.nan, np.nan
    other = turned(turn, inner[0], inner[1], 1.0)
    base = (pin_hole[0] - centre[0], pin_hole[1] - centre[1], pin_hole[2] - centre[2])
    point, gap = closest(direction, other, base, 0.0)
    square = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    along = (point[0] * direction[0] + point[1] * direction[1] + point[2] * direction[2]) / square
    return along, gap


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


@kernel
def _meet_block(
    start: int, stop: int, reference: tuple[Floats, Floats, Floats], turns: Floats, shifts: Floats,
    pin_holes: Floats, lenses: Floats, pixels: Floats, places: Floats, sigma: Floats, slopes: Floats,
    xyz: Floats, covariance: Floats, gap: Floats, chi_square: Floats, freedom: NDArray[np.int32],
    by_own: Floats,
) -> None:  # fmt: skip
    """Do the work of `meet_rays` for points start .. stop.

    Unknown are the depth and by how much, (a, b) in px, the reference camera's noise has moved the matches of
    all partners; each image has half of a match's variance.
    """
    turn, centre, lens = reference
    inner, seen = np.empty(6), np.empty(8)
    for i in range(start, stop):
        depth = np.nan
        count, own = _own_variance(places, sigma, i)
        if count == 0 or not undistorted(lens, pixels[:, i], inner):
            continue
        d = turned(turn, inner[0], inner[1], 1.0)
        across = turned(turn, inner[2], inner[4], 0.0)
        down = turned(turn, inner[3], inner[5], 0.0)
        for k in range(len(lenses)):
            if np.isnan(depth) and np.isfinite(places[k, 0, i]):
                depth, gap[i] = _first_depth(
                    d, centre, turns[k], pin_holes[k], lenses[k], places[k, :, i], inner
                )
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
                    j = 2 + 3 * axis
                    by_z = _along(d, seen, j)
                    by_a, by_b = slopes[k, axis, 0, i], slopes[k, axis, 1, i]
                    if not (np.isfinite(by_a) and np.isfinite(by_b)):
                        by_a, by_b = depth * _along(across, seen, j), depth * _along(down, seen, j)
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


def meet_rays(
    reference: Camera,
    partners: Sequence[Camera],
    pixels: Floats,
    places: Floats,
    sigma: Floats,
    slopes: Floats | None = None,
    threads: int = 1,
) -> SeenPoints:
    """Find the points of pixels of a reference camera from where partners see them.

    Parameters
    ----------
    reference, partners
        The cameras.
    pixels
        (2, n), x and y in the reference camera's image, in px.
    places, sigma
        (partners, 2, n), where each partner sees them and the standard deviations of the matches, in px;
        NaN where it does not.
    slopes
        (partners, 2, 2, n), how places change along the surface with the pixel: dx'/dx, dx'/dy in the first
        row, dy'/dx, dy'/dy in the second. Where they are NaN, or None, the surface is taken to face the
        reference camera.
    threads
        How many threads to use; the result does not depend on it.

    Notes
    -----
    Least squares in the images, with distortion where it is: no image is resampled. A match's variance is
    half of the reference image and half of the partner's. The former moves the matches of all partners alike,
    and is estimated with the depth, so that the covariance of a depth from three cameras is not that of
    independent pairs; how far it moves them depends on the surface's tilt, which `slopes` tell. The point is
    taken on the pixel's own ray, which is free of noise, being named by its pixel. With N the normal matrix
    in (a, b, depth) and v the variance of a, matches that are moved as by a = 1 move the solution by
    N^-1 (N - 1 / v) e_a, and so the depth by -1 / v times its covariance with a in N^-1.
    """
    count = pixels.shape[1]
    result = SeenPoints(
        np.full((3, count), np.nan),
        np.full((6, count), np.nan),
        np.full(count, np.nan),
        np.full(count, np.nan),
        np.zeros(count, dtype=np.int32),
        np.full((2, count), np.nan),
    )
    own = (reference.pose.matrix(), reference.pose.centre(), reference.intrinsics.vector())
    turns = np.stack([camera.pose.matrix() for camera in partners])
    shifts = np.array([camera.pose.translation for camera in partners])
    pin_holes = np.stack([camera.pose.centre() for camera in partners])
    lenses = np.stack([camera.intrinsics.vector() for camera in partners])
    if slopes is None:
        slopes = np.broadcast_to(np.nan, (len(partners), 2, 2, count))
    at, seen, spread, along = (
        np.ascontiguousarray(a, dtype=np.float64) for a in (pixels, places, sigma, slopes)
    )

    def work(start: int, stop: int) -> None:
        _meet_block(
            start, stop, own, turns, shifts, pin_holes, lenses, at, seen, spread, along,
            result.xyz, result.covariance, result.ray_gap, result.chi_square, result.freedom, result.by_own,
        )  # fmt: skip

    in_row_blocks(work, count, threads, block=4096)
    return result


@kernel
def _fill_slopes(place: Floats, lever: int, slopes: Floats) -> None:
    """Do the work of `slopes_of_places`."""
    rows, columns = place.shape[1:]
    for k in range(2):
        for axis in range(2):
            down, right = (0, lever) if axis == 0 else (lever, 0)
            for r in range(rows):
                for c in range(columns):
                    here, ahead, behind = place[k, r, c], np.nan, np.nan
                    if r + down < rows and c + right < columns:
                        ahead = place[k, r + down, c + right]
                    if r >= down and c >= right:
                        behind = place[k, r - down, c - right]
                    slope = (ahead - behind) / (2 * lever)
                    if np.isnan(slope):
                        slope = (ahead - here) / lever
                    if np.isnan(slope):
                        slope = (here - behind) / lever
                    slopes[k, axis, r, c] = slope


def slopes_of_places(place: Floats, lever_px: int) -> Floats:
    """Return how places (2, rows, columns) change with the pixel, (2, 2, rows, columns): by x, then by y.

    Taken between the pixels `lever_px` to either side, or from one side where the other has no place; NaN
    where neither has.
    """
    slopes = np.empty((2, 2, *place.shape[1:]))
    _fill_slopes(np.ascontiguousarray(place), lever_px, slopes)
    return slopes


def directions_across_rays(reference: Camera, partner: Camera) -> Floats:
    """Return unit vectors (2, rows, columns) in the reference image along which depth moves no match.

    They are at right angles to the epipolar line of the pixel. One is taken for 16 px a side, over which
    lines hardly turn; NaN at the epipole and outside the lens's valid field.
    """
    rows, columns = reference.rows, reference.columns
    y, x = (np.minimum(np.arange(0, size, _SIDE) + _SIDE // 2, size - 1.0) for size in (rows, columns))
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    intrinsics, pose = reference.intrinsics, reference.pose
    ahead = pose.centre() + ray_directions(intrinsics, pose, pixels)
    # To move a point towards the partner is to move it within the plane of both pin-holes and itself.
    along = projection_jacobian(intrinsics, pose, ahead) @ (partner.pose.centre() - pose.centre())
    with np.errstate(invalid="ignore"):
        across = np.stack([-along[..., 1], along[..., 0]]) / np.hypot(along[..., 0], along[..., 1])
    return np.repeat(np.repeat(across, _SIDE, axis=1), _SIDE, axis=2)[:, :rows, :columns]


def depths_in_box(
    camera: Camera, pixels: Floats, low: tuple[float, float, float], high: tuple[float, float, float]
) -> tuple[Floats, Floats, Floats]:
    """Return the directions (n, 3) of rays and the distances, in mm, where they enter and leave a box.

    `pixels` is (n, 2); NaN where a ray misses the box.
    """
    centre = camera.pose.centre()
    rays = ray_directions(camera.intrinsics, camera.pose, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = ((np.asarray(corner) - centre) / rays for corner in (low, high))
    near = np.maximum(np.nanmax(np.minimum(first, second), axis=1), 0.0)
    far = np.nanmin(np.maximum(first, second), axis=1)
    missed = ~(far > near)
    near[missed] = far[missed] = np.nan
    return rays, near, far


def points_along_rays(camera: Camera, rays: Floats, near: Floats, far: Floats, count: int) -> Floats:
    """Return `count` points on each ray (n, 3) of a camera between two distances (n,), (n, count, 3) in mm.

    The farthest first, in even steps of inverse distance: those are about even in another camera's image.
    """
    share = np.linspace(0.0, 1.0, count)
    with np.errstate(divide="ignore"):
        along = 1.0 / ((1.0 - share) / far[:, None] + share / np.maximum(near, 1e-3 * far)[:, None])
    return np.asarray(camera.pose.centre() + along[..., None] * rays[:, None])


def plane_warps(
    reference: Camera, partner: Camera, pixels: Floats, points: Floats, normals: Floats, lever: float
) -> tuple[Floats, Floats]:
    """Return where a partner sees points of planes, and the slopes of the map between the images there.

    Parameters
    ----------
    pixels
        (n, 2), of the reference camera.
    points, normals
        (n, m, 3): on each pixel's ray m points in mm, each on a plane with this normal.
    lever
        Half the distance in px over which slopes are taken: a subset's radius.

    Returns
    -------
    places
        (n, m, 2), px; NaN behind the partner.
    slopes
        (n, m, 2, 2): dx'/dx, dx'/dy in the first row, dy'/dx, dy'/dy in the second, without distortion being
        neglected: it is the map of a plane between two distorted images (a homography without distortion).
    """
    centre = reference.pose.centre()
    places = project(partner.intrinsics, partner.pose, points)
    slopes = np.empty((*places.shape, 2))
    offset = np.sum((points - centre) * normals, axis=-1)
    for axis in range(2):
        ends = []
        for side in (-lever, lever):
            beside = pixels.copy()
            beside[:, axis] += side
            rays = ray_directions(reference.intrinsics, reference.pose, beside)
            with np.errstate(divide="ignore", invalid="ignore"):
                along = offset / np.einsum("ni,nmi->nm", rays, normals)
            met = centre + np.where(along > 0.0, along, np.nan)[..., None] * rays[:, None]
            ends.append(project(partner.intrinsics, partner.pose, met))
        slopes[..., axis] = (ends[1] - ends[0]) / (2.0 * lever)
    return places, slopes
