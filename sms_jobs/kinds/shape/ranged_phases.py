"""Phases by Fourier domain ranging: returns of every orientation, paired by geometry, slab by slab."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.shape.phase_task import UNWRAPPING, Known, PhaseTask, mark, noise_reasons
from sms_jobs.kinds.shape.streaming import in_best_exposure, sampled
from sms_jobs.metrology.arrays import Floats, Reasons, Singles
from sms_jobs.metrology.geometry.ray_pairing import CandidateReturns, Pairing, PairingRule
from sms_jobs.metrology.images.masks import phase_error_factor
from sms_jobs.metrology.phase.fourier_domain_ranging import Returns, range_returns, score_threshold
from sms_jobs.metrology.phase.fringe_blur import transfer_of_sample
from sms_jobs.metrology.phase.merged_returns import merged_sigma
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.ranging.harmonics import ghost_error
from sms_jobs.metrology.phase.ranging.misfit import misfit_factor
from sms_jobs.metrology.phase.ranging.plan import CLOSE_BINS
from sms_jobs.metrology.phase.response import Response
from sms_jobs.records.fields import PhaseMaps, ReturnMaps
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.reasons import Reason

_SAMPLED = (4, 512)  # rows, and pixels of each, that tell the modulation transfer


def transfers(task: PhaseTask) -> list[Floats]:
    """Return the modulation transfer over the densities of each orientation, from a sample of the rows."""
    measurement, sequence = task.measurement, task.measurement.sequence
    frames, _ = in_best_exposure(measurement, sampled(measurement.frames, *_SAMPLED))
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
    found = _found(task, known, frames)
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
    if returns is not None:
        returns.label[rows], returns.margin[rows] = pairing.label, pairing.margin
        for k, one in enumerate(found):
            returns.omega[k, :, rows] = one.omega
            returns.omega_sigma[k, :, rows] = one.omega_sigma
            returns.amplitude[k, :, rows] = one.amplitude


def _found(task: PhaseTask, known: Known, frames: NDArray[Any]) -> list[Returns]:
    """Return the returns of every orientation."""
    measurement, parameters, sequence = task.measurement, task.parameters, task.measurement.sequence
    every = [
        range_returns(
            frames[sequence.frames_of(k)],
            sequence.densities,
            sequence.steps,
            measurement.grey_levels,
            returns=parameters.returns,
            window=parameters.window,
            significance=parameters.significance,
            mtf=known.transfers[k],
            response=known.responses[k] if known.corrected else None,
            threads=task.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]
    every = _with_misfit(task, every)
    if known.corrected:
        return every
    return [
        one if response is None else replace(one, omega_sigma=_with_ghosts(one, response, sequence))
        for one, response in zip(every, known.responses, strict=True)
    ]


def _with_misfit(task: PhaseTask, every: list[Returns]) -> list[Returns]:
    """Return the returns of all orientations with what is left beyond noise in their standard deviations.

    Light that is not sharp in one orientation is not in another, where two close returns may hide that: the
    largest factor holds for all.
    """
    limit = _noise_limit(task)
    factors = [misfit_factor(f.residual, task.measurement.noise(f.mean_intensity), limit) for f in every]
    largest = np.fmax.reduce(factors)
    return [replace(f, omega_sigma=np.asarray(f.omega_sigma * largest, np.float32)) for f in every]


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
