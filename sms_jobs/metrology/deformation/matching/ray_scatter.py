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
_CAP = 16.0  # of a squared deviation in units of its variance: what is farther off is no scatter
_ENOUGH = 0.25  # of the squared deviations that a window could hold
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
    most, so that a few false matches are not taken for scatter; where most are larger, they are scatter, and
    the mean square is that of a normal error whose squares, cut off there, have this mean.
    """
    matches = _at_the_place(found.matches)
    found = replace(found, matches=matches)
    off = matches_off_rays(reference, partner, found, threads)
    row, column = found.y // spacing, found.x // spacing
    lattice = np.full((row.max(initial=0) + 1, column.max(initial=0) + 1), np.nan)
    lattice[row, column] = off
    subset = -(-(2 * radius + 1) // spacing)
    square = _mean_squares(lattice, subset, subset)[row, column]
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
    """Return by how many deviations, with a sign, matches (n,) lie off the images of their rays.

    NaN for those that have not converged.
    """
    good = np.flatnonzero(found.matches.ending == CONVERGED)
    pixels = np.stack([found.x[good], found.y[good]]).astype(np.float64)
    warp, sigma = found.matches.warp[good].T, found.matches.sigma[good].T
    slopes = warp[[1, 2, 4, 5]].reshape(2, 2, -1) + np.eye(2)[..., None]
    off = np.full(len(found.x), np.nan)
    off[good] = _off_rays(reference, partner, pixels, pixels + warp[[0, 3]], sigma, slopes, threads)
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
    places one subset, one and a half and three apart, the largest of them within a subset's width; NaN where
    no places are seen.

    Notes
    -----
    Spreading makes noise less, and leaves what neighbouring matches are off by together, as in haze. Of noise
    alone the largest is 2 at most.
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
    # Waves that are as long as a distance show nothing over it, and longer ones less.
    each = (_mean_squares(off.reshape(shape), round(times * subset), subset) for times in _DISTANCES)
    square = np.fmax.reduce(list(each))
    # Along rays nothing is seen, and waves there have their nodes elsewhere.
    square = ndimage.maximum_filter(square, 2 * subset + 1)
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
    """Return by how many deviations, with a sign, places (2, n) lie off the images of the rays of pixels."""
    met = meet_rays(reference, [partner], pixels, place[None], sigma[None], slopes[None], threads)
    ahead = met.xyz.T + _AHEAD * (met.xyz.T - reference.pose.centre())
    here, there = (project(partner.intrinsics, partner.pose, points).T for points in (met.xyz.T, ahead))
    along, away = there - here, place - here
    return np.asarray(np.sqrt(met.chi_square) * np.sign(along[0] * away[1] - along[1] * away[0]))


def _mean_squares(lattice: Floats, apart: int, subset: int) -> Floats:
    """Return the mean square about each node of second differences over `apart` nodes, over 6.

    `lattice` (rows, columns) is by how many deviations nodes are off, and `subset` how many of them a subset
    is wide; NaN everywhere where too few are known.
    """
    squares = np.zeros((2, *lattice.shape))
    counts = np.zeros((2, *lattice.shape))
    for axis in range(2):
        line = np.moveaxis(lattice, axis, 0)
        if len(line) <= 2 * apart:
            continue
        bend = (line[: -2 * apart] - 2.0 * line[apart:-apart] + line[2 * apart :]) ** 2 / 6.0
        known = np.isfinite(bend)
        np.moveaxis(squares[axis], axis, 0)[apart:-apart] = np.where(known, np.minimum(bend, _CAP), 0.0)
        np.moveaxis(counts[axis], axis, 0)[apart:-apart] = known
    size = 2 * _WIDTHS * subset + 1
    total, share = (
        ndimage.uniform_filter(one.sum(axis=0), size, mode="constant") for one in (squares, counts)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(share > _ENOUGH, _not_cut_off(total / share), np.nan)
    known = np.isfinite(mean)
    if not known.any():
        return np.full(lattice.shape, np.nan)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(mean[tuple(nearest)])


def _not_cut_off(mean: Floats) -> Floats:
    """Return the mean squares of normal errors whose squares, none counted for more than `_CAP`, have a mean.

    E min(t z^2, c) = t (erf(a / sqrt 2) - 2 a phi(a)) + c (1 - erf(a / sqrt 2)), with a^2 = c / t.
    """
    cut_off, whole = _means_cut_off()
    return np.asarray(np.interp(mean, cut_off, whole))


@cache
def _means_cut_off() -> tuple[Floats, Floats]:
    """Return means of squares that are cut off, and of the same squares that are not."""
    whole = np.concatenate([[0.0], np.geomspace(1e-3, 1e6, 1000)])
    with np.errstate(divide="ignore"):
        a = np.sqrt(_CAP / whole)
    inside = erf(a / np.sqrt(2.0))
    inner = np.concatenate([[0.0], (inside - a * np.sqrt(2.0 / np.pi) * np.exp(-0.5 * a**2))[1:]])
    return whole * inner + _CAP * (1.0 - inside), whole
