"""How wrong matches between cameras are, by what they scatter across the images of their rays."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy import ndimage
from scipy.special import erf

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.matching.correlation import CONVERGED, Matches
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.geometry.camera import Camera, project
from sms_jobs.metrology.geometry.several_cameras import meet_rays

_WIDTHS = 2  # subsets on either side whose scatter is taken
_CAP = 16.0  # of a squared deviation in units of its variance: of few, what is farther off is no scatter
_MOSTLY = 0.5  # of that the mean may be; more is scatter, and cut off at 16 times as much
_ENOUGH = 0.125  # of the squared deviations that a window could hold
_DISTANCES = (1.0, 1.5, 3.0)  # between places that are compared, in widths of a subset
_AHEAD = 1e-3  # part of its distance by which a point is moved along its ray


def stated_by_rays(
    reference: Camera, partner: Camera, found: GridMatches, radius: int, spacing: int, threads: int = 1
) -> GridMatches:
    """Return matches with deviations that fit how far off the images of their rays they scatter.

    Parameters
    ----------
    reference, partner
        The cameras.
    found
        Their matches at nodes of a grid.
    radius, spacing
        Of the subsets and of the grid, in px.
    threads
        How many threads to use; the result does not depend on it.

    Returns
    -------
    The matches with other `sigma`, of the place in the partner's image, and with `misfit` what their variance
    is of that by noise.

    Notes
    -----
    What subsets leave over is no noise where two cameras show a texture differently, and its size does not
    tell the error: blur hardly moves a match, what is sampled coarsely moves it more than noise of that size.
    But across the image of its ray a match's error is seen, whatever it comes from and whatever shape the
    surface has. Second differences between subsets that just do not overlap are free of what the calibration
    is wrong by, which changes slowly; their mean square over some subsets on either side is what the stated
    variance is multiplied by, along the ray too, but never to less than noise. Each counts for 16 of them at
    most, so that a few false matches are not taken for scatter, and the mean square is that of normal errors
    whose squares, cut off there, have this mean. Where most are larger, they are scatter, and are cut off at
    16 times as much, and so on.
    """
    matches = _at_the_place(found.matches)
    found = replace(found, matches=matches)
    row, column = found.y // spacing, found.x // spacing
    lattice = np.full((2, row.max(initial=0) + 1, column.max(initial=0) + 1), np.nan)
    lattice[:, row, column] = matches_off_rays(reference, partner, found, threads)
    subset = -(-(2 * radius + 1) // spacing)
    square = _mean_squares(_differences(lattice, subset), subset)[row, column]
    told = np.maximum(matches.misfit, 1.0)
    times = np.maximum(np.where(np.isfinite(square), square, 1.0), 1.0 / told)
    return replace(
        found, matches=replace(matches, sigma=matches.sigma * np.sqrt(times)[:, None], misfit=told * times)
    )


def _at_the_place(matches: Matches) -> Matches:
    """Return matches with deviations of the place in the partner's image, not of the step that led there.

    That is in the reference image: F = 1 + grad u times as long in the partner's.
    """
    ux, uy, vx, vy = matches.warp[:, [1, 2, 4, 5]].T
    u, v = matches.sigma.T
    sigma = np.stack([np.hypot((1.0 + ux) * u, uy * v), np.hypot(vx * u, (1.0 + vy) * v)], axis=1)
    return replace(matches, sigma=sigma)


def matches_off_rays(reference: Camera, partner: Camera, found: GridMatches, threads: int = 1) -> Floats:
    """Return how far matches lie off the images of their rays, with a sign, and the deviations, (2, n) in px.

    NaN for those that have not converged.
    """
    good = np.flatnonzero(found.matches.ending == CONVERGED)
    pixels = np.stack([found.x[good], found.y[good]]).astype(np.float64)
    warp, sigma = found.matches.warp[good].T, found.matches.sigma[good].T
    slopes = warp[[1, 2, 4, 5]].reshape(2, 2, -1) + np.eye(2)[..., None]
    off = np.full((2, len(found.x)), np.nan)
    off[:, good] = _off_rays(reference, partner, pixels, pixels + warp[[0, 3]], sigma, slopes, threads)
    return off


def scatter_of_places(
    reference: Camera, partner: Camera, place: Floats, variance: Floats, radius: int, threads: int = 1
) -> Floats:
    """Return by how much places scatter across the images of their rays at most, in units of their variance.

    Parameters
    ----------
    reference, partner
        The cameras.
    place, variance
        (2, rows, columns): where the partner sees what each pixel of the reference camera sees, px, and the
        variances, px^2; NaN for nowhere.
    radius
        Of the subsets whose matches have been spread to the pixels, px.
    threads
        How many threads to use; the result does not depend on it.

    Returns
    -------
    (rows, columns): the mean square of second differences about each pixel, as `stated_by_rays` takes it, of
    places one subset, one and a half and three apart; the largest of them within one and a half subsets on
    either side. NaN where no places are seen.

    Notes
    -----
    Spreading makes noise less, and leaves what neighbouring matches are off by together, as in haze. On clean
    images the largest is 2.1 (ADR 121).
    """
    step = max(1, radius // 2)
    seen, spread = place[:, ::step, ::step], variance[:, ::step, ::step]
    shape = seen.shape[1:]
    pixels = step * np.indices(shape)[::-1].reshape(2, -1).astype(np.float64)
    slopes = np.stack([_central(seen, axis, step) for axis in (2, 1)], axis=1).reshape(2, 2, -1)
    off = _off_rays(
        reference, partner, pixels, seen.reshape(2, -1), np.sqrt(spread).reshape(2, -1), slopes, threads
    )
    subset = -(-(2 * radius + 1) // step)
    lattice, each = off.reshape(2, *shape), []
    # Waves that are as long as a distance show nothing over it, and longer ones less.
    for times in _DISTANCES:
        squares = _differences(lattice, round(times * subset))
        # What is too narrow for one axis would show nothing of waves that run along it.
        along, down = (_mean_squares(own[None], subset) for own in squares)
        each.append(np.where(np.isnan(along + down), np.fmax(along, down), 0.5 * (along + down)))
    square = np.fmax.reduce(each)
    # Along rays nothing is seen, and waves there have their nodes elsewhere.
    square = ndimage.maximum_filter(square, 3 * subset + 1)
    rows, columns = (np.arange(length) // step for length in place.shape[1:])
    return np.asarray(square[np.ix_(rows, columns)])


def _central(values: Floats, axis: int, step: int) -> Floats:
    """Return derivatives by central differences along an axis, NaN at its ends."""
    slope = np.full(values.shape, np.nan)
    line, inner = (np.moveaxis(one, axis, 0) for one in (values, slope))
    inner[1:-1] = (line[2:] - line[:-2]) / (2.0 * step)
    return slope


def _off_rays(
    reference: Camera,
    partner: Camera,
    pixels: Floats,
    place: Floats,
    sigma: Floats,
    slopes: Floats,
    threads: int,
) -> Floats:
    """Return how far places lie off the images of rays, with a sign, and the deviations, (2, n) in px."""
    met = meet_rays(reference, [partner], pixels, place[None], sigma[None], slopes[None], threads)
    ahead = met.xyz.T + _AHEAD * (met.xyz.T - reference.pose.centre())
    here, there = (project(partner.intrinsics, partner.pose, points).T for points in (met.xyz.T, ahead))
    along, away = there - here, place - here
    distance = (along[0] * away[1] - along[1] * away[0]) / np.hypot(*along)
    with np.errstate(invalid="ignore", divide="ignore"):
        deviation = np.abs(distance) / np.sqrt(met.chi_square)
    usual = np.sqrt(np.mean(sigma**2, axis=0))  # where a place lies on the very line
    return np.stack([distance, np.where(np.isfinite(deviation) & (deviation > 0.0), deviation, usual)])


def _differences(lattice: Floats, apart: int) -> Floats:
    """Return squares of second differences along either axis, (2, rows, columns), in their variances.

    `lattice` (2, rows, columns) is how far nodes are off and their deviations, and `apart` how many nodes lie
    between those that are compared. Where deviations change, what all nodes are off by alike is no
    difference.
    """
    squares = np.full(lattice.shape, np.nan)
    for axis in range(2):
        own = np.moveaxis(squares[axis], axis, 0)
        off, deviation = (np.moveaxis(one, axis, 0) for one in lattice)
        if len(off) > 2 * apart:
            bend = off[: -2 * apart] - 2.0 * off[apart:-apart] + off[2 * apart :]
            variance = deviation**2
            own[apart:-apart] = bend**2 / (
                variance[: -2 * apart] + 4.0 * variance[apart:-apart] + variance[2 * apart :]
            )
    return squares


def _mean_squares(squares: Floats, subset: int) -> Floats:
    """Return the mean of squares (k, rows, columns) about each node; NaN everywhere where too few are known.

    `subset` is how many nodes a subset is wide. Nodes about which too few are known have that of the nearest.
    """
    size = 2 * _WIDTHS * subset + 1
    count = np.isfinite(squares).mean(axis=0)
    share = ndimage.uniform_filter(count, size, mode="constant")
    cap, mean, cut = _CAP, np.full(share.shape, np.nan), share > _ENOUGH
    while cut.any():
        sums = np.nansum(np.minimum(squares, cap), axis=0) / len(squares)
        part = ndimage.uniform_filter(sums, size, mode="constant")[cut] / share[cut] / cap
        mean[cut] = cap * _not_cut_off(part)
        cut[cut] = part > _MOSTLY
        cap *= _CAP
    known = np.isfinite(mean)
    if not known.any():
        return mean
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(mean[tuple(nearest)])


def _not_cut_off(mean: Floats) -> Floats:
    """Return the mean squares of normal errors whose squares, none counted for more than 1, have a mean.

    E min(t z^2, 1) = t (erf(a / sqrt 2) - 2 a phi(a)) + 1 - erf(a / sqrt 2), with a^2 = 1 / t.
    """
    cut_off, whole = _means_cut_off()
    return np.asarray(np.interp(mean, cut_off, whole))


@cache
def _means_cut_off() -> tuple[Floats, Floats]:
    """Return means of squares that are cut off, and of the same squares that are not."""
    whole = np.geomspace(1e-4, 1e3, 1000)
    a = 1.0 / np.sqrt(whole)
    inside = erf(a / np.sqrt(2.0))
    cut_off = whole * (inside - a * np.sqrt(2.0 / np.pi) * np.exp(-0.5 * a**2)) + 1.0 - inside
    return np.append(0.0, cut_off), np.append(0.0, whole)
