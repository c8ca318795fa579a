"""The displacement of points that each camera has followed through images of its own, and its covariance.

A point is where the rays of all cameras meet, before and after. What the match between cameras is off by at
the reference state moves the point. If each camera goes on from there by its own texture, it moves the end
alike, and hardly anything is left of it in the displacement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.geometry.camera import Camera
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.several_cameras import meet_rays

_STEP_PX = 0.1
"""By which images are moved to see how points move; slopes are off by its part of a disparity."""


@dataclass(frozen=True)
class StartPlaces:
    """Where partners see n points at the reference state.

    Attributes
    ----------
    place
        (partners, 2, n) in px; NaN where one does not see a point.
    slopes
        (partners, 2, 2, n), how places change with the reference camera's pixel.
    depth_variance, noise_part
        (n,): the variance in mm^2 of a point along its ray by these matches, and what of it is noise.
    """

    place: Floats
    slopes: Floats
    depth_variance: Floats
    noise_part: Floats


@dataclass(frozen=True)
class FollowedPlaces:
    """Where a camera sees n points later, and how well it is known.

    Attributes
    ----------
    place
        (2, n) in px; NaN where it does not see a point.
    variance, noise
        (2, n) in px^2: of the match by all that is in both images, and by their noise alone, half of each.
    bias
        (2, n) in px^2, what the images have against the match.
    slopes
        (2, 2, n), how the place changes with the pixel of the first image that was matched.
    """

    place: Floats
    variance: Floats
    noise: Floats
    bias: Floats
    slopes: Floats

    def at(self, rows: Ints, columns: Ints) -> FollowedPlaces:
        """Return it at some pixels of an image, of which it is all."""
        return FollowedPlaces(*(values[..., rows, columns] for values in vars(self).values()))


@dataclass(frozen=True)
class FollowedPoints:
    """Displacements of n points; NaN where no partner sees them both before and after.

    Attributes
    ----------
    displacement
        (3, n) in mm.
    covariance, bias
        (6, n) in mm^2, packed XX, XY, XZ, YY, YZ, ZZ: all, and the part that is the matches' bias.
    miss
        (n,), by what the rays miss each other after, squared in units of what the matches state.
    """

    displacement: Floats
    covariance: Floats
    bias: Floats
    miss: Floats


@dataclass(frozen=True)
class _Meeting:
    """Where rays meet, (3, n) in mm, and how that moves with each camera's image, in mm / px."""

    xyz: Floats
    by_pixel: Floats
    by_place: Floats
    miss: Floats


class _Sum:
    """The covariance (6, n) of independent errors, each of which moves points by (3, n)."""

    def __init__(self, count: int) -> None:
        self.packed = np.zeros((6, count))

    def add(self, error: Floats) -> None:
        """Add one error."""
        at = 0
        for i in range(3):
            for j in range(i, 3):
                self.packed[at] += error[i] * error[j]
                at += 1


def followed_displacement(
    cameras: tuple[Sequence[Camera], Sequence[Camera]],
    pixels: Floats,
    start: StartPlaces,
    own: FollowedPlaces,
    partners: Sequence[FollowedPlaces],
    correlation: NDArray[np.floating],
    *,
    by_own_texture: bool,
    threads: int = 1,
) -> FollowedPoints:
    """Return how points move by where each camera sees them before and after.

    Parameters
    ----------
    cameras
        At the reference state and later: the reference camera, then its partners.
    pixels
        (2, n), x and y in the reference camera's first image, in px.
    start
        Where partners see the points at the reference state.
    own, partners
        Where the reference camera and each partner see them later.
    correlation
        (n,), of what one image's noise does to a match in time and to one between cameras.
    by_own_texture
        Whether partners were followed from their own first images; else they were matched with that of the
        reference camera.
    threads
        How many threads to use; the result does not depend on it.

    Notes
    -----
    With J the change of the first meeting with a partner's place, K and M those of the last with the end
    pixel and the partner's place there, F and F_p the gradients of matches in time, G and H those of matches
    between cameras, of the last image and of the first, the displacement is off by

        K (F e - l) + sum (A (H e' - p' + b) + M (F_p p - l_p))        A = M F_p - J      by their own texture
        K (F e - l) + sum (A (H e' - p' + b) + M (G e' - l_p))         A = -J             by the first image

    e, p, l, l_p being what the noise of the first and last images of reference camera and partner does to
    matches in time, e' and p' what it does to those between cameras (`take_common_noise`), and b what the
    latter leave over, which goes with the point: where motion turns nothing, A is near 0. To l and l_p
    belongs what matches leave over in time. Partners that do not see a point at both states have no part in
    either meeting. All of a match's variance between cameras follows from that of the depth.
    """
    last = np.stack([end.place for end in partners])
    seen = np.asarray(np.isfinite(start.place + last).all(axis=1, keepdims=True))
    first, last = (np.where(seen, places, np.nan) for places in (start.place, last))
    between = _variance_between(cameras[0], pixels, start, threads)
    sigma = np.stack([np.sqrt(between + own.variance + end.variance) for end in partners])
    before = _meet(cameras[0], pixels, first, sigma, threads)
    after = _meet(cameras[1], own.place, last, sigma, threads)
    count = pixels.shape[1]
    noise, bias = _Sum(count), _Sum(count)
    shared, left = correlation, np.sqrt(1.0 - correlation**2)
    between_noise = np.sqrt(0.5 * start.noise_part * between)
    between_left = np.sqrt((1.0 - start.noise_part) * between)

    def none_for_nan(values: Floats) -> Floats:
        return np.nan_to_num(values, nan=0.0)

    ends = [
        FollowedPlaces(*(np.where(k, values, 0.0) for values in vars(end).values()))
        for end, k in zip(partners, seen[:, 0], strict=True)
    ]
    carried = [
        _product(after.by_place[k], end.slopes) if by_own_texture else np.zeros((3, 2, count))
        for k, end in enumerate(ends)
    ]
    by_start = [carried[k] - before.by_place[k] for k in range(len(ends))]
    own_first = _product(after.by_pixel, own.slopes)
    for axis in range(2):
        in_time = own_first[:, axis] * np.sqrt(0.5 * own.noise[axis])
        across = np.zeros((3, count))
        for k, end in enumerate(ends):
            slopes = none_for_nan(start.slopes[k])
            across += _product(by_start[k], slopes)[:, axis] * between_noise
            if not by_own_texture:
                later = _product(after.by_place[k], end.slopes)[:, axis]
                across += later * np.sqrt(0.5 * end.noise[axis])
        noise.add(in_time + shared * across)
        noise.add(left * across)
        noise.add(own_first[:, axis] * np.sqrt(np.maximum(own.variance[axis] - 0.5 * own.noise[axis], 0.0)))
        bias.add(after.by_pixel[:, axis] * np.sqrt(own.bias[axis]))
        for k, end in enumerate(ends):
            from_start = -by_start[k][:, axis] * between_noise
            followed = carried[k][:, axis] * np.sqrt(0.5 * end.noise[axis])
            noise.add(followed + shared * from_start)
            noise.add(left * from_start)
            noise.add(by_start[k][:, axis] * between_left)
            rest = np.sqrt(np.maximum(end.variance[axis] - 0.5 * end.noise[axis], 0.0))
            noise.add((carried[k] if by_own_texture else after.by_place[k])[:, axis] * rest)
            bias.add(after.by_place[k][:, axis] * np.sqrt(end.bias[axis]))
    moved = after.xyz - before.xyz
    packed = np.where(np.isfinite(moved[0]), noise.packed + bias.packed, np.nan)
    return FollowedPoints(moved, packed, np.where(np.isfinite(moved[0]), bias.packed, np.nan), after.miss)


def _product(first: Floats, second: Floats) -> Floats:
    """Return the products of matrices (i, j, n) and (j, k, n), (i, k, n)."""
    return np.asarray(np.einsum("ijn,jkn->ikn", first, second))


def _variance_between(cameras: Sequence[Camera], pixels: Floats, start: StartPlaces, threads: int) -> Floats:
    """Return the variance (n,) in px^2 of matches between cameras, all alike, that a depth's comes of."""
    one = np.ones_like(start.place)
    met = meet_rays(cameras[0], cameras[1:], pixels, start.place, one, start.slopes, threads)
    return np.asarray(start.depth_variance / trace(met.covariance))


def _meet(cameras: Sequence[Camera], pixels: Floats, places: Floats, sigma: Floats, threads: int) -> _Meeting:
    """Return where the rays of the reference camera's `pixels` (2, n) and of partners' `places` meet."""

    def met(at: Floats, seen: Floats) -> Floats:
        return meet_rays(cameras[0], cameras[1:], at, seen, sigma, threads=threads).xyz

    found = meet_rays(cameras[0], cameras[1:], pixels, places, sigma, threads=threads)
    by_pixel, by_place = np.empty((3, *pixels.shape)), np.empty((len(places), 3, *pixels.shape))
    for axis in range(2):
        moved = pixels.copy()
        moved[axis] += _STEP_PX
        by_pixel[:, axis] = (met(moved, places) - found.xyz) / _STEP_PX
        for k in range(len(places)):
            seen = places.copy()
            seen[k, axis] += _STEP_PX
            by_place[k, :, axis] = (met(pixels, seen) - found.xyz) / _STEP_PX
    miss = found.chi_square / np.maximum(found.freedom, 1)
    return _Meeting(found.xyz, by_pixel, by_place, miss)
