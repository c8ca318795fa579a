"""Phases by Fourier domain ranging: returns of every orientation, paired by geometry, slab by slab."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.shape.phase_task import UNWRAPPING, Known, PhaseParameters, PhaseTask, mark, noise_reasons
from sms_jobs.kinds.shape.streaming import RowSample, some_rows
from sms_jobs.metrology.arrays import Floats, Mask, Reasons, Singles
from sms_jobs.metrology.geometry.ray_pairing import (
    AMPLITUDE_TOLERANCE,
    CandidateReturns,
    Pairing,
    PairingRule,
)
from sms_jobs.metrology.images.masks import phase_error_factor
from sms_jobs.metrology.phase.fourier_domain_ranging import Returns, range_returns, score_threshold
from sms_jobs.metrology.phase.fringe_blur import transfer_of_sample
from sms_jobs.metrology.phase.merged_returns import merged_sigma
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.ranging.harmonics import ghost_error, ghost_level
from sms_jobs.metrology.phase.ranging.misfit import misfit_factor
from sms_jobs.metrology.phase.ranging.plan import CLOSE_BINS
from sms_jobs.metrology.phase.ranging.shared_amplitudes import CloseReturns, ToldApart, tell_apart
from sms_jobs.metrology.phase.response import Response
from sms_jobs.records.fields import PhaseMaps, ReturnMaps
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason

_TELLING = 32  # rows of which are the pixels that tell what holds for the whole image
_BESIDE = 4  # of these rows lie side by side: few places of a recording are read
_SAMPLED = 64  # pixels of each that tell the modulation transfer
_COMPARED = 512  # and how far amplitudes of two orientations agree
_WELL_APART = 1.5  # bins: a second return raises the bound of omega by 2 %
_TOLD_APART = 0.7  # bins: by 40 %
_WIDTH_SIGMA = 1.5  # of a sharp return's width, times s, over the root of noise by amplitude: see `Returns`
_SHARP = 1.4  # such deviations of a width: two of its square
_LEAST_TELLING = 30  # pixels whose median tells that
_MEDIAN_OF_SQUARES = 0.4549  # of a normal number of standard deviation 1
_LEAST_SPREAD = 0.01  # what a median of so few can miss


def rows_that_tell(measurement: Measurement) -> RowSample:
    """Return the rows that tell the modulation transfer, and how far amplitudes of orientations agree."""
    return some_rows(measurement, _TELLING, _BESIDE)


def transfers(task: PhaseTask, sample: RowSample) -> list[Floats]:
    """Return the modulation transfer over the densities of each orientation, from few pixels of a sample."""
    measurement, sequence = task.measurement, task.measurement.sequence
    frames = sample.pixels(_SAMPLED)
    return [
        transfer_of_sample(
            frames[sequence.frames_of(k)],
            sequence.densities,
            sequence.steps,
            measurement.grey_levels,
            threads=task.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]


def range_slab(
    task: PhaseTask,
    known: Known,
    rows: slice,
    frames: NDArray[Any],
    phase: PhaseMaps,
    returns: ReturnMaps | None,
    reason: Reasons,
) -> None:
    """Fill the rows of `phase` and `returns`, and mark in `reason` what cannot be trusted."""
    found, ambiguous = _found(task, known, frames)
    pairing = _paired(task, rows, found)
    phase.omega[:, rows] = pairing.omega
    phase.omega_sigma[:, rows] = np.hypot(pairing.omega_sigma, _merged_sigma(task, found, pairing))
    for k, one in enumerate(found):
        with np.errstate(divide="ignore", invalid="ignore"):
            error = phase_sigma(one.residual, pairing.amplitude[k], task.measurement.sequence.steps)
        phase.modulation[k, rows] = one.modulation
        phase.phase_error[k, rows] = error
        phase.mean_intensity[rows] += one.mean_intensity / len(found)
        reason[rows] |= _range_reasons(task, one, pairing.amplitude[k], error)
    if task.parameters.pair_rule == "likelihood":
        mark(reason[rows], pairing.margin < task.parameters.minimum_pair_margin, Reason.AMBIGUOUS_PAIR)
    mark(reason[rows], ambiguous, Reason.AMBIGUOUS_PAIR)
    if returns is not None:
        returns.label[rows], returns.margin[rows] = pairing.label, pairing.margin
        for k, one in enumerate(found):
            returns.omega[k, :, rows] = one.omega
            returns.omega_sigma[k, :, rows] = one.omega_sigma
            returns.amplitude[k, :, rows] = one.amplitude


def _found(task: PhaseTask, known: Known, frames: NDArray[Any]) -> tuple[list[Returns], Mask]:
    """Return the returns of every orientation, and where it is open which of two places they come from."""
    every = _ranged(task, known.transfers, known.responses if known.corrected else None, frames)
    every, ambiguous = _told_apart(task, known, frames, every)
    every = _with_misfit(task, known, every)
    if known.corrected:
        return every, ambiguous
    sequence = task.measurement.sequence
    return [
        one if response is None else replace(one, omega_sigma=_with_ghosts(one, response, sequence))
        for one, response in zip(every, known.responses, strict=True)
    ], ambiguous


def _ranged(
    task: PhaseTask,
    transfers: list[Floats],
    responses: list[Response | None] | None,
    frames: NDArray[Any],
) -> list[Returns]:
    """Return the returns of every orientation by itself; harmonics are taken out if responses are given."""
    measurement, parameters, sequence = task.measurement, task.parameters, task.measurement.sequence
    return [
        range_returns(
            frames[sequence.frames_of(k)],
            sequence.densities,
            sequence.steps,
            measurement.grey_levels,
            returns=parameters.returns,
            window=parameters.window,
            significance=parameters.significance,
            mtf=transfers[k],
            response=None if responses is None else responses[k],
            threads=task.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]


def shares_amplitudes(parameters: PhaseParameters) -> bool:
    """Say whether close returns of one orientation are told apart by the amplitudes of another."""
    return parameters.returns > 1 and parameters.pair_rule == "likelihood"


def _told_apart(
    task: PhaseTask, known: Known, frames: NDArray[Any], found: list[Returns]
) -> tuple[list[Returns], Mask]:
    """Return the returns with those that lie close fitted by the amplitudes that another orientation tells.

    With them come the pixels where the weaker return may lie on either side.
    """
    measurement, sequence = task.measurement, task.measurement.sequence
    ambiguous = np.zeros(found[0].count.shape, np.bool_)
    if not shares_amplitudes(task.parameters):
        return found, ambiguous
    apart = [_apart_bins(one, sequence) for one in found]
    telling = [np.where(_are_sharp(task, one), bins, 0.0) for one, bins in zip(found, apart, strict=True)]
    better = list(found)
    for k, one in enumerate(found):
        widest = np.argmax(telling, axis=0)
        close = (one.count > 0) & (apart[k] < _WELL_APART)
        close &= np.max(telling, axis=0) >= np.maximum(_TOLD_APART, 2.0 * apart[k])
        for j in sorted({*widest[close].tolist()}):
            where = close & (widest == j)
            told = found[j].amplitude[:2, where].astype(np.float64)
            noise = told * _relative_sigma(found[j].omega_sigma[:2, where], sequence)
            returns = CloseReturns(
                where,
                np.concatenate([one.omega[:2, where], one.amplitude[:2, where]]),
                told,
                np.hypot(noise, known.amplitude_spread * told),
            )
            fitted = tell_apart(
                frames[sequence.frames_of(k)],
                sequence.densities,
                sequence.steps,
                measurement.grey_levels,
                known.transfers[k],
                returns,
                response=known.responses[k] if known.corrected else None,
                threads=task.threads,
            )
            better[k] = _with_fitted(better[k], where, fitted)
            ambiguous[where] |= fitted.ambiguous & ~fitted.against
    return better, ambiguous


def _apart_bins(one: Returns, sequence: FringeSequence) -> Floats:
    """Return the distance of two returns in bins of 2 pi / s; 0 where there are not two."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(one.omega[0] - one.omega[1]) * len(sequence.densities) / (2.0 * np.pi)
    return np.where(one.count == 2, apart, 0.0)


def _are_sharp(task: PhaseTask, one: Returns) -> Mask:
    """Return where no return is wider than a point: what is spread is not as bright in every orientation."""
    sequence = task.measurement.sequence
    noise = task.measurement.noise(one.mean_intensity)
    with np.errstate(invalid="ignore"):
        sigma = _WIDTH_SIGMA * np.sqrt(np.sqrt(4.0 / sequence.steps) * noise / one.amplitude)
        wide = one.width * len(sequence.densities) > _SHARP * sigma
    return np.asarray(~wide.any(axis=0))


def _relative_sigma(omega_sigma: Singles, sequence: FringeSequence) -> Floats:
    """Return the relative standard deviations of the amplitudes of returns from those of their omega."""
    return np.asarray(omega_sigma * np.sqrt(np.mean(np.square(sequence.densities))), np.float64)


def _with_fitted(one: Returns, where: Mask, fitted: ToldApart) -> Returns:
    """Return the returns of an orientation with those of some pixels as they were fitted, strongest first."""
    kept = np.zeros_like(where)
    kept[where] = ~fitted.against
    order = np.argsort(-fitted.amplitude, axis=0)
    maps = {}
    for name in ("omega", "omega_sigma", "amplitude"):
        maps[name] = getattr(one, name).copy()
        values = np.take_along_axis(getattr(fitted, name), order, axis=0)
        maps[name][:2, kept] = values[:, ~fitted.against]
    count = np.where(kept, 2, one.count).astype(np.uint8)
    return replace(one, **maps, count=count)


def amplitude_spread(
    task: PhaseTask, sample: RowSample, transfers: list[Floats], responses: list[Response | None] | None
) -> float:
    """Return by which part amplitudes of one return differ between orientations, beside noise.

    As a standard deviation, in a sample of the rows: where two orientations tell two returns well apart.
    """
    found = _ranged(task, transfers, responses, sample.pixels(_COMPARED))
    sequence = task.measurement.sequence
    well = [_apart_bins(one, sequence) >= _WELL_APART for one in found]
    squares = [
        np.median(
            np.log(found[j].amplitude[rank, both] / found[k].amplitude[rank, both]) ** 2 / _MEDIAN_OF_SQUARES
            - sum(_relative_sigma(found[i].omega_sigma[rank, both], sequence) ** 2 for i in (j, k))
        )
        for j, k in combinations(range(len(found)), 2)
        if np.count_nonzero(both := well[j] & well[k]) >= _LEAST_TELLING
        for rank in (0, 1)
    ]
    if not squares:
        return AMPLITUDE_TOLERANCE
    return max(float(np.sqrt(max(*squares, 0.0))), _LEAST_SPREAD)


def _with_misfit(task: PhaseTask, known: Known, every: list[Returns]) -> list[Returns]:
    """Return the returns of all orientations with what is left beyond noise in their standard deviations.

    Light that is not sharp in one orientation is not in another, where two close returns may hide that: the
    largest factor holds for all. What the harmonics leave is stated by itself.
    """
    limit = _noise_limit(task)
    factors = [
        misfit_factor(one.residual, _noise_with_ghosts(task, known, one, response), limit)
        for one, response in zip(every, known.responses, strict=True)
    ]
    largest = np.fmax.reduce(factors)
    return [replace(f, omega_sigma=np.asarray(f.omega_sigma * largest, np.float32)) for f in every]


def _noise_with_ghosts(task: PhaseTask, known: Known, one: Returns, response: Response | None) -> Singles:
    """Return the noise of a frame, with the harmonics that stay in the signal, in grey levels."""
    measurement, sequence = task.measurement, task.measurement.sequence
    noise = measurement.noise(one.mean_intensity)
    if known.corrected or response is None:
        return noise
    return np.hypot(
        noise, ghost_level(one.amplitude, response, sequence.densities, sequence.steps), dtype=np.float32
    )


def _noise_limit(task: PhaseTask) -> float:
    """Return how many times its noise a pixel's phase error may be by noise alone."""
    sequence, parameters = task.measurement.sequence, task.parameters
    freedom = 2 * len(sequence.densities) - 2 * parameters.returns + 1
    return phase_error_factor(freedom, parameters.kept_by_phase_error)


def _with_ghosts(one: Returns, response: Response, sequence: FringeSequence) -> Singles:
    """Return the standard deviations of returns with what the harmonics left in them."""
    left = ghost_error(one.omega, one.amplitude, response, sequence.densities, sequence.steps)
    return np.asarray(np.hypot(one.omega_sigma, left), np.float32)


def _paired(task: PhaseTask, rows: slice, found: list[Returns]) -> Pairing:
    """Choose, pixel by pixel, the returns of the orientations that belong to one point."""
    if task.geometry is None:
        raise InvalidInput(f"method={task.parameters.method} needs a calibration; set method={UNWRAPPING}")
    geometry, parameters = task.geometry, task.parameters
    low, high = geometry.volume.low, geometry.volume.high
    middle = np.reshape(np.add(low, high) / 2.0, (3, 1, 1))
    densities = np.array(task.measurement.sequence.densities, dtype=np.float64)
    candidates = CandidateReturns(
        np.stack([f.omega for f in found]),
        np.stack([f.omega_sigma for f in found]),
        np.stack([f.amplitude for f in found]),
    )
    rule = PairingRule(
        low,
        high,
        gap_floor_mm=float(geometry.gap_sigma_mm(middle)[0, 0]),
        density_rms=float(np.sqrt(np.mean(densities**2))),
        peak_rad=CLOSE_BINS * 2.0 * pi / len(densities),
        least_gap=parameters.pair_rule == "least-gap",
    )
    return geometry.pair.choose(rows, candidates, rule)


def _merged_sigma(task: PhaseTask, found: list[Returns], pairing: Pairing) -> Singles:
    """Return the standard deviation that a second return too weak to be separated adds to the chosen one."""
    sequence = task.measurement.sequence
    return merged_sigma(
        [task.measurement.noise(f.mean_intensity) for f in found],
        pairing.amplitude,
        [f.amplitude for f in found],
        threshold=score_threshold(task.parameters.significance, len(sequence.densities)),
        densities=len(sequence.densities),
        steps=sequence.steps,
    )


def _range_reasons(task: PhaseTask, one: Returns, amplitude: Singles, error: Singles) -> Reasons:
    """Return the reasons for which the phases of one orientation are not to be trusted."""
    reason = noise_reasons(
        amplitude,
        error,
        _noise_limit(task),
        0.0,
        task.measurement.noise(one.mean_intensity),
        task.measurement.sequence.steps,
        task.parameters,
    )
    mark(reason, one.saturated, Reason.SATURATED)
    mark(reason, (one.count == 0) & ~one.saturated, Reason.LOW_MODULATION)
    return reason
