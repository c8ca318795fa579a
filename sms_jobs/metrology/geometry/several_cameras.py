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
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.geometry.camera import (
    Camera,
    project,
    projection_jacobian,
    ray_directions,
)
from sms_jobs.metrology.geometry.meeting_kernels import meet_block

_SIDE = 16
"""Of squares in px over which epipolar lines are taken to have one direction."""


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
        meet_block(
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
