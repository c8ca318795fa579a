"""How wrong matches between cameras are, by what they scatter across the images of their rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.deformation.matching.correlation import CONVERGED, Matches
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.geometry.camera import Camera, project
from sms_jobs.metrology.geometry.several_cameras import meet_rays

_WIDTHS = 2  # subsets on either side whose scatter is taken
_CAP = 16.0  # of a squared deviation in units of its variance: what is farther off is no scatter
_ENOUGH = 0.25  # of the squared deviations that a window could hold
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
    variance is multiplied by, along the ray too, but never to less than noise.
    """
    matches = _at_the_place(found.matches)
    found = replace(found, matches=matches)
    square = _mean_squares(_off_rays(reference, partner, found, threads), found, radius, spacing)
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


def _off_rays(reference: Camera, partner: Camera, found: GridMatches, threads: int) -> Floats:
    """Return by how many deviations, with a sign, matches (n,) lie off the images of their rays."""
    off = np.full(len(found.x), np.nan)
    good = np.flatnonzero(found.matches.ending == CONVERGED)
    pixels = np.stack([found.x[good], found.y[good]]).astype(np.float64)
    warp, sigma = found.matches.warp[good].T, found.matches.sigma[good].T
    place = pixels + warp[[0, 3]]
    slopes = warp[[1, 2, 4, 5]].reshape(2, 2, -1) + np.eye(2)[..., None]
    met = meet_rays(reference, [partner], pixels, place[None], sigma[None], slopes[None], threads)
    ahead = met.xyz.T + _AHEAD * (met.xyz.T - reference.pose.centre())
    here, there = (project(partner.intrinsics, partner.pose, points).T for points in (met.xyz.T, ahead))
    along, away = there - here, place - here
    off[good] = np.sqrt(met.chi_square) * np.sign(along[0] * away[1] - along[1] * away[0])
    return off


def _mean_squares(off: Floats, found: GridMatches, radius: int, spacing: int) -> Floats:
    """Return the mean square about each node of second differences of what nodes (n,) are off by, over 6."""
    row, column = found.y // spacing, found.x // spacing
    lattice = np.full((row.max(initial=0) + 1, column.max(initial=0) + 1), np.nan)
    lattice[row, column] = off
    apart = -(-(2 * radius + 1) // spacing)
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
    size = 2 * _WIDTHS * apart + 1
    total, share = (
        ndimage.uniform_filter(one.sum(axis=0), size, mode="constant") for one in (squares, counts)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(share > _ENOUGH, total / share, np.nan)
    known = np.isfinite(mean)
    if not known.any():
        return np.full(len(off), np.nan)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(mean[tuple(nearest)][row, column])
