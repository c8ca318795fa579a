"""Which returns of the fringe orientations belong together: the choice among all candidate pairs.

A pixel that is lit in several ways has several phase gradients in each orientation, and nothing in the
frames says which of one orientation goes with which of another. Every combination names a ray of the
projector; only light that came straight from the projector meets the camera's ray (thesis section 7.2.3 and
Fig. 94). Four things speak for a combination:

- the ray gap, in units of its predicted standard deviation;
- amplitudes that agree, since a path is equally bright in every orientation;
- a point inside the measurement volume;
- with more than two orientations, phase gradients that name one point of the projector.

What they cannot tell: light that reached the surface by way of a mirror and came back by the same mirror
meets the camera's ray in the mirror image of the point, with no gap and equal amplitudes, and only the
volume refutes it; and where the detour lies in the epipolar plane of the camera's ray, its gap is as small
as that of the direct light. One orientation has no gap at all: there the volume alone decides. The margin to
the runner-up says how much better the chosen pair is, so that such pixels are known.

Light from a patch of the projector's image, such as that of a surface out of focus, is a return that is
spread. Ranging finds it as two sharp ones to either side of its middle, which fit it as well; where all
returns of every orientation may be one such return, its middle is a runner-up, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import in_row_blocks, kernel
from sms_jobs.metrology.geometry.pair_likelihood import (
    Pair,
    Settings,
    new_combination,
    runner_up,
    split,
    take,
    take_spread,
    weigh,
)
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.triangulation import Projector, packed, triangulate
from sms_jobs.metrology.phase.patterns import direction, span_px

Labels = NDArray[np.uint16]
_MOST_COMBINATIONS = 4096
_OUTSIDE = 1e3  # in log-likelihood: more than any gap of a pixel that would be kept
AMPLITUDE_TOLERANCE = 0.15
"""Relative standard deviation of an amplitude between orientations, whose fringes are blurred differently."""
_LARGEST_AMPLITUDE_CHI2 = 9.0  # returns that merged in one orientation must not outvote the gap
_ONE_PLACE = 3.0  # standard deviations of depth within which two candidates are one point


@dataclass(frozen=True)
class CandidateReturns:
    """The returns of every pixel to choose among; all are (orientations, returns, rows, columns).

    Attributes
    ----------
    omega, omega_sigma
        In rad per fringe; NaN behind the last return of a pixel.
    amplitude
        The returns' modulation in grey levels.
    """

    omega: Floats
    omega_sigma: Singles
    amplitude: Singles


@dataclass(frozen=True)
class PairingRule:
    """What a choice among returns goes by.

    Attributes
    ----------
    low, high
        Corners of the measurement volume, (3,) in mm.
    gap_floor_mm
        Standard deviation of the gap from anything but the phase's noise, above all the calibration.
    density_rms
        Root mean square of the fringe densities: an amplitude's relative standard deviation is this times
        that of omega.
    peak_rad
        Returns within this of each other may be one that is spread, in rad per fringe.
    least_gap
        True for the plain rule of the thesis: the least ray gap, whatever else speaks against it.
    """

    low: Sequence[float]
    high: Sequence[float]
    gap_floor_mm: float
    density_rms: float
    peak_rad: float
    least_gap: bool = False


@dataclass(frozen=True)
class Pairing:
    """The chosen combination of every pixel; the arrays are over (orientations, rows, columns) or an image.

    Attributes
    ----------
    omega, omega_sigma, amplitude
        (orientations, rows, columns), of the chosen returns; NaN where an orientation has none.
    label
        (rows, columns), 1 + index of the combination, the last orientation's return counting fastest, in the
        order of the returns: 1 (1, 1), 2 (1, 2), 3 (2, 1), 4 (2, 2) for two returns of two orientations, as
        in thesis Fig. 106. 0 where there is none.
    margin
        (rows, columns), log-likelihood of the chosen combination above that of the best one that gives
        another point; infinite where there is no other. Negative where the thesis's rule chose against the
        evidence, or where one spread return explains more than all the sharp ones.
    """

    omega: Floats
    omega_sigma: Singles
    amplitude: Singles
    label: Labels
    margin: Singles


@kernel
def _choose_rows(
    rays: Floats,
    omega: Floats,
    sigma: Singles,
    amplitude: Singles,
    pair: Pair,
    box: Floats,
    settings: Settings,
    block: tuple[int, int],
    chosen: Floats,
    chosen_maps: Singles,
    label: Labels,
    margin: Singles,
) -> None:
    """Choose for a block of rows; `chosen_maps` is (2, orientations, rows, columns): sigma and amplitude."""
    orientations, returns = omega.shape[0], omega.shape[1]
    counts, which = np.empty(orientations, np.int64), np.empty(orientations, np.int64)
    one = new_combination(orientations)
    everywhere = np.empty((2, 3))
    everywhere[0], everywhere[1] = -np.inf, np.inf
    most = returns**orientations + 1  # and one that is spread
    likelihood, depth, variance = np.empty(most), np.empty(most), np.empty(most)
    for row in range(block[0], block[1]):
        for column in range(omega.shape[3]):
            combinations = 1
            for k in range(orientations):
                counts[k] = 0
                while counts[k] < returns and not np.isnan(omega[k, counts[k], row, column]):
                    counts[k] += 1
                combinations *= counts[k]
            best, least_gap = 0, np.inf
            margin[row, column] = np.inf
            if combinations > 1:
                u = (rays[row, column, 0], rays[row, column, 1], rays[row, column, 2])
                for c in range(combinations):
                    split(c, counts, which)
                    take(omega, sigma, amplitude, which, (row, column), one)
                    likelihood[c], gap, depth[c], variance[c] = weigh(u, one, pair, box, settings)
                    if settings[6] and abs(gap) < least_gap:
                        best, least_gap = c, abs(gap)
                    if not settings[6] and likelihood[c] > likelihood[best]:
                        best = c
                others = combinations
                if take_spread(omega, sigma, amplitude, counts, (row, column), settings[7], one):
                    # Outside the volume, too: the chosen one must not be valid for lying within.
                    likelihood[others], _, depth[others], variance[others] = weigh(
                        u, one, pair, everywhere, settings
                    )
                    others += 1
                second = runner_up(best, likelihood, depth, variance, others, settings[5])
                if second > -np.inf:
                    margin[row, column] = likelihood[best] - second
            which[:] = 0
            if combinations > 0:
                split(best, counts, which)
            number = 0
            for k in range(orientations):
                number = number * returns + which[k]
                chosen[k, row, column] = omega[k, which[k], row, column]
                chosen_maps[0, k, row, column] = sigma[k, which[k], row, column]
                chosen_maps[1, k, row, column] = amplitude[k, which[k], row, column]
            label[row, column] = 1 + number if combinations > 0 else 0


def choose_returns(
    camera_centre: Floats,
    rays: Floats,
    projector: Projector,
    orientations: Sequence[float],
    candidates: CandidateReturns,
    rule: PairingRule,
    *,
    threads: int = 1,
) -> Pairing:
    """Choose for every pixel the combination of returns that is light straight from the projector.

    Parameters
    ----------
    camera_centre
        Pin-hole of the camera in the world, (3,) in mm.
    rays
        (rows, columns, 3) unit directions in the world, from `camera_rays`.
    projector
        Whose distortion is removed from the rays.
    orientations
        Directions of the fringes in rad.
    candidates
        The returns of all orientations.
    rule
        What the choice goes by.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    The log-likelihood of a combination of M returns is

        -1/2 [gap^2 / var + ln var + min(chi2_a, 9) + chi2_omega] - 1000 outside,

    with var the variance of the gap from the noise of omega and the floor, chi2_a that of the logarithms of
    the amplitudes about their mean, with 15 % for unequal blur, and chi2_omega that of the residuals of
    omega for M > 2. The margin is also that above one return which is spread, where all of every orientation
    lie within `peak_rad`: omega is their mean by amplitude, and no volume counts. The least-gap
    alternative is thesis section 7.2.3, with epsilon_1 of its Fig. 12.

    Raises `InvalidInput` for parallel orientations and for more than 4096 combinations.
    """
    count, returns, rows, columns = candidates.omega.shape
    if returns**count > _MOST_COMBINATIONS:
        raise InvalidInput(
            f"{returns} returns of {count} fringe orientations make {returns**count} combinations, more than "
            f"the {_MOST_COMBINATIONS} that can be compared: ask for fewer returns"
        )
    if count == 1:
        return _choose_alone(camera_centre, rays, projector, orientations, candidates, rule, threads)
    spans = np.array([span_px(projector.columns, projector.rows, a) for a in orientations])
    to_omega = np.array([direction(a) for a in orientations]) * (2.0 * pi / spans)[:, None]
    pair = (*packed(camera_centre, projector, orientations), to_omega)
    box = np.array([rule.low, rule.high], dtype=np.float64)
    settings = (
        float(rule.gap_floor_mm),
        float(rule.density_rms),
        AMPLITUDE_TOLERANCE,
        _LARGEST_AMPLITUDE_CHI2,
        _OUTSIDE,
        _ONE_PLACE,
        bool(rule.least_gap),
        float(rule.peak_rad),
    )
    chosen = np.empty((count, rows, columns))
    maps = np.empty((2, count, rows, columns), np.float32)
    label = np.empty((rows, columns), np.uint16)
    margin = np.empty((rows, columns), np.float32)

    def work(start: int, stop: int) -> None:
        _choose_rows(
            rays,
            candidates.omega,
            candidates.omega_sigma,
            candidates.amplitude,
            pair,
            box,
            settings,
            (start, stop),
            chosen,
            maps,
            label,
            margin,
        )

    in_row_blocks(work, rows, threads, block=8)
    return Pairing(chosen, maps[0], maps[1], label, margin)


def _choose_alone(
    camera_centre: Floats,
    rays: Floats,
    projector: Projector,
    orientations: Sequence[float],
    candidates: CandidateReturns,
    rule: PairingRule,
    threads: int,
) -> Pairing:
    """Choose among the returns of one orientation: the first, which is the strongest, inside the volume."""
    omega, omega_sigma = candidates.omega, candidates.omega_sigma
    _, returns, rows, columns = omega.shape
    likelihood = np.full((returns, rows, columns), -np.inf)
    depth, spread = np.full_like(likelihood, np.nan), np.zeros_like(likelihood)
    corners = np.reshape(rule.low, (3, 1, 1)), np.reshape(rule.high, (3, 1, 1))
    for number in range(returns):
        found = triangulate(
            camera_centre,
            rays,
            projector,
            orientations,
            np.ascontiguousarray(omega[:, number]),
            np.ascontiguousarray(omega_sigma[:, number]),
            threads=threads,
        )
        met = np.isfinite(found.xyz[0])
        outside = ((found.xyz < corners[0]) | (found.xyz > corners[1])).any(axis=0)
        likelihood[number] = np.where(met, np.where(outside, -_OUTSIDE, 0.0), -np.inf)
        depth[number] = np.sum((found.xyz - camera_centre[:, None, None]) * np.moveaxis(rays, -1, 0), axis=0)
        spread[number] = trace(found.covariance)
    best = np.argmax(likelihood, axis=0)

    def of_best(values: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.asarray(np.take_along_axis(values, best[None], axis=0)[0])

    near = np.abs(depth - of_best(depth)) <= _ONE_PLACE * np.sqrt(spread + of_best(spread))
    others = np.where(near | (np.arange(returns)[:, None, None] == best), -np.inf, likelihood)
    second = others.max(axis=0)
    finite = np.isfinite(second)
    margin = np.full((rows, columns), np.inf, np.float32)
    margin[finite] = of_best(likelihood)[finite] - second[finite]
    label = np.where(np.isfinite(omega[0, 0]), best + 1, 0).astype(np.uint16)
    return Pairing(
        of_best(omega[0])[None].astype(np.float64),
        of_best(omega_sigma[0])[None].astype(np.float32),
        of_best(candidates.amplitude[0])[None].astype(np.float32),
        label,
        margin,
    )
