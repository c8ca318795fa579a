"""Whether fringes run along the directions that are told: rays that meet in the volume must say so."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations, product
from math import degrees, pi

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.shape.phase_task import Geometry
from sms_jobs.metrology.images.masks import large_ray_gap, outside_box
from sms_jobs.records.fields import PhaseMaps
from sms_jobs.records.subject import Subject

_ROWS = 32  # that are looked at
_LEAST_PIXELS = 200
_LEAST_SHARE = 0.5
_OTHER_SHARE = 0.8
"""Of the pixels that meet: below the first something is wrong, above the second it is explained."""
_COARSE_PX = 0.5  # of the projector, that directions are judged by: a calibration may be worse than it says
_SIGMAS = 4.0


def check_directions(
    subject: Subject, geometry: Geometry, phase: PhaseMaps, trusted: NDArray[np.bool_]
) -> None:
    """Check that the directions in which the phases grow are those that are told.

    Parameters
    ----------
    phase
        Of a whole image, with what noise makes of it.
    trusted
        (rows, columns): pixels whose phases can be.

    Raises
    ------
    MeasurementFailed
        The rays of most pixels miss each other, or the volume, while with other directions they meet in it.

    Notes
    -----
    Along one direction alone every ray meets its surface of phase, so that the volume alone tells: directions
    that put the specimen into a large volume cannot be distinguished.
    """
    every = max(1, trusted.shape[0] // _ROWS)
    trusted = trusted[::every]
    if np.count_nonzero(trusted) < _LEAST_PIXELS:
        return
    omega = np.ascontiguousarray(phase.omega[:, ::every])
    sigma = np.ascontiguousarray(phase.omega_sigma[:, ::every])

    def share(orientations: tuple[float, ...]) -> float:
        turned = replace(
            geometry, pair=replace(geometry.pair, orientations=orientations), gap_sigma_px=_COARSE_PX
        )
        points = turned.pair.meet(omega, sigma, every)
        lost = np.isnan(points.xyz[0]) | outside_box(points.xyz, geometry.volume.low, geometry.volume.high)
        lost |= large_ray_gap(points.ray_gap, points.ray_gap_sigma, turned.gap_sigma_mm(points.xyz), _SIGMAS)
        return float(np.mean(~lost[trusted]))

    told = geometry.pair.orientations
    if share(told) >= _LEAST_SHARE:
        return
    shares = {other: share(other) for other in _others(told)}
    best = max(shares, key=lambda other: shares[other])
    if shares[best] < _OTHER_SHARE:
        return
    along, were = (" and ".join(f"{degrees(one):g}" for one in some) for some in (best, told))
    raise MeasurementFailed(
        f"the fringes of {subject} seem to run along {along} deg, not along {were} deg as stated: "
        f"{shares[best]:.0%} of the rays meet in the volume so, and {share(told):.0%} otherwise; correct the "
        "orientations or the order of the frames"
    )


def _others(told: tuple[float, ...]) -> Iterator[tuple[float, ...]]:
    """Yield other directions: in another order, turned round, and, of a single one, across."""
    start = permutations(told) if len(told) > 1 else iter([told, (told[0] + pi / 2,)])
    for ordered, turns in product(start, product((0.0, pi), repeat=len(told))):
        other = tuple((a + turn) % (2.0 * pi) for a, turn in zip(ordered, turns, strict=True))
        if not np.allclose(np.cos(np.subtract(other, told)), 1.0):
            yield other
