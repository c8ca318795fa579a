"""The phases of a tuple: frames slab by slab to phase gradients, and a reason for what cannot be trusted.

Of several exposures every pixel takes its best one, so that the camera's noise model holds for all that
follows; grey levels are put in units of exposure 1 when all else is done. Where the projector's response is
to be corrected it is found first, in a sample of the frames themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.foreign_patterns import coarse_gradient, offsets_of, refuse_foreign_patterns
from sms_jobs.kinds.fringe_response import SampledResponse, SampleParameters, sampled_response
from sms_jobs.kinds.kind import Parameters, Progress
from sms_jobs.kinds.streaming import exposed_slabs, in_best_exposure, sampled
from sms_jobs.metrology.geometry.sensor_pair import SensorPair
from sms_jobs.metrology.geometry.triangulation import Projector
from sms_jobs.metrology.images.masks import high_phase_error, low_modulation, phase_error_factor
from sms_jobs.metrology.phase.fourier_domain_ranging import range_returns, score_threshold
from sms_jobs.metrology.phase.fringe_blur import transfer_of_sample
from sms_jobs.metrology.phase.merged_returns import merged_sigma
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.ranging.signal import Window
from sms_jobs.metrology.phase.ripple_table import RippleTable, ripple_table
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.records.campaign import Subject
from sms_jobs.records.fields import PhaseMaps, ReturnMaps
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Box, Sensor

Reasons = NDArray[np.uint32]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Frames = NDArray[Any]

_SAMPLED = (4, 512)  # rows, and pixels of each, that tell the modulation transfer

Method = Literal["temporal-unwrapping", "fdr", "fdr-improved", "fdr-original"]
UNWRAPPING: Method = "temporal-unwrapping"
RANGING: dict[str, Any] = {
    "fdr": "known-origin",
    "fdr-improved": "improved",
    "fdr-original": "original",
}
"""What the ranging methods are called where they are described."""


class PhaseParameters(Parameters):
    """How phases are found, and which of them are trusted."""

    method: Method = Field(
        "temporal-unwrapping",
        description="how the phase gradient is found: temporal unwrapping of any unambiguous densities, or "
        "Fourier domain ranging over the densities 0, 1, 2 ..: 'fdr' with known origin and several returns, "
        "'fdr-improved' and 'fdr-original' as in the thesis",
    )
    returns: int = Field(1, ge=1, le=4, description="most returns that are looked for in a pixel")
    refinements: int = Field(
        1, ge=0, le=20, description="how often each return is found again with the others taken away"
    )
    joint: bool = Field(True, description="whether all returns are finally fitted together (method fdr)")
    window: Window = Field("none", description="weights over the densities against leakage of strong returns")
    significance: float = Field(
        1e-4, gt=0.0, lt=1.0, description="probability at which noise alone is taken for one more return"
    )
    pair_rule: Literal["likelihood", "least-gap"] = Field(
        "likelihood",
        description="how returns of the orientations are paired: by gap, amplitudes and volume, or by the "
        "least ray gap alone, as in the thesis",
    )
    minimum_pair_margin: float = Field(
        3.0,
        ge=0.0,
        description="log-likelihood by which the chosen pair must excel any pair of another place; 3 are "
        "odds of 20",
    )
    minimum_modulation_to_noise: float = Field(
        5.0, ge=0.0, description="least fringe modulation in standard deviations of the camera's noise"
    )
    minimum_modulation_count: float = Field(
        0.0, ge=0.0, description="least fringe modulation in grey levels, besides that"
    )
    kept_by_phase_error: float = Field(
        0.999,
        gt=0.0,
        lt=1.0,
        description="part of good pixels whose phase error from noise alone is accepted",
    )
    maximum_phase_error_rad: float = Field(
        0.02, ge=0.0, description="phase error of the fringes themselves that is accepted on top of the noise"
    )
    maximum_ray_gap_to_noise: float = Field(
        4.0, gt=0.0, description="largest gap between the rays in standard deviations from noise"
    )
    maximum_ray_gap_mm: float = Field(
        0.2,
        ge=0.0,
        description="gap between the rays, from calibration, that is accepted on top of the noise",
    )
    response: Literal["none", "measured"] = Field(
        "none",
        description="whether the ripple of a projector that is not linear is found in the frames themselves "
        "and taken out: 'measured' costs a second or two, for temporal unwrapping and one return of fdr",
    )

    @field_validator("returns")
    @classmethod
    def _have_a_method(cls, returns: int, given: ValidationInfo) -> int:
        if returns > 1 and given.data.get("method") == UNWRAPPING:
            raise ValueError(
                "temporal unwrapping knows one return only; set method=fdr to tell several apart"
            )
        return returns

    @field_validator("response")
    @classmethod
    def _correct_what_is_known(cls, response: str, given: ValidationInfo) -> str:
        method, returns = given.data.get("method"), given.data.get("returns")
        if response == "measured" and (method not in (UNWRAPPING, "fdr") or returns != 1):
            raise ValueError(
                "the projector's response is corrected for temporal unwrapping and for method=fdr with "
                "returns=1; set response=none for the others"
            )
        return response


@dataclass(frozen=True)
class Geometry:
    """Where sensors and specimen are: by this returns are paired."""

    pair: SensorPair
    volume: Box


@dataclass(frozen=True)
class PhaseTask:
    """What the frames of a tuple are turned into phases with; only ranging needs the geometry."""

    subject: Subject
    measurement: Measurement
    parameters: PhaseParameters
    threads: int
    geometry: Geometry | None = None


@dataclass(frozen=True)
class Phases:
    """What the frames of a tuple tell.

    Attributes
    ----------
    maps
        Phase gradients of the pair's light.
    returns
        All returns, if there can be several.
    reason
        (rows, columns): why a pixel is not to be trusted.
    response
        Of the projector, if it was corrected.
    """

    maps: PhaseMaps
    returns: ReturnMaps | None
    reason: Reasons
    response: SampledResponse | None


@dataclass(frozen=True)
class _Known:
    """What is known before the first slab: modulation transfers and ripples of the orientations, or none."""

    transfers: list[Floats]
    ripples: list[RippleTable]


def find_phases(task: PhaseTask, progress: Progress) -> Phases:
    """Return the phases of a tuple, its returns if there can be several, and the pixels not to be trusted.

    Raises `MeasurementFailed` when the response is to be corrected and cannot be found, and `InvalidInput`
    for ranging without a geometry.
    """
    measurement, parameters = task.measurement, task.parameters
    if parameters.method != UNWRAPPING and task.geometry is None:
        raise InvalidInput(f"method={parameters.method} needs a calibration; set method={UNWRAPPING}")
    sequence = measurement.sequence
    if parameters.method != UNWRAPPING or parameters.response != "none":
        refuse_foreign_patterns(task.subject, measurement, f"method={UNWRAPPING} with response=none")
    _, rows, columns = measurement.frames.shape
    phase = PhaseMaps.unset(sequence.orientations_rad, rows, columns, bracketed=sequence.exposures != (1.0,))
    reason = np.zeros((rows, columns), np.uint32)
    returns = None
    if parameters.returns > 1:
        returns = ReturnMaps.unset(sequence.orientations_rad, parameters.returns, rows, columns)
    response = _response(task)
    ripples = [] if response is None else _ripples(response, sequence.steps)
    known = _Known([] if parameters.method == UNWRAPPING else _transfers(task), ripples)
    for slab, frames, exposure in exposed_slabs(measurement, task.threads):
        if parameters.method == UNWRAPPING:
            _unwrap_slab(task, known, slab, frames, phase, reason)
        else:
            _range_slab(task, known, slab, frames, phase, returns, reason)
        del frames  # before the next slab is asked for: two of them are in memory, not three
        _at_exposure_one(slab, exposure, phase, returns)
        progress(0.8 * slab.stop / rows, f"found phases in {slab.stop} of {rows} rows")
    return Phases(phase, returns, reason, response)


def _response(task: PhaseTask) -> SampledResponse | None:
    if task.parameters.response == "none":
        return None
    return sampled_response(task.subject, task.measurement, SampleParameters(), task.threads)


def _ripples(response: SampledResponse, steps: int) -> list[RippleTable]:
    return [ripple_table(one, response.densities, steps) for one in response.responses]


def _at_exposure_one(rows: slice, exposure: Singles, phase: PhaseMaps, returns: ReturnMaps | None) -> None:
    """Put the grey levels of a slab in units of the camera's own exposure."""
    phase.modulation[:, rows] /= exposure
    phase.mean_intensity[rows] /= exposure
    if phase.exposure is not None:
        phase.exposure[rows] = exposure
    if returns is not None:
        returns.amplitude[:, :, rows] /= exposure


def _unwrap_slab(
    task: PhaseTask, known: _Known, rows: slice, frames: Frames, phase: PhaseMaps, reason: Reasons
) -> None:
    """Fill the rows of `phase` and mark those pixels in `reason` whose phase cannot be trusted."""
    measurement, parameters = task.measurement, task.parameters
    sequence = measurement.sequence
    densities = tuple(t for t in sequence.densities if t)
    for k in range(len(sequence.orientations_rad)):
        fringes = frames[sequence.frames_of(k, uniform=False)]
        found = unwrap(
            fringes,
            densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            offsets=offsets_of(measurement),
            coarse=coarse_gradient(measurement, k, rows, fringes),
            threads=task.threads,
        )
        phase.omega[k, rows] = found.omega
        phase.omega_sigma[k, rows] = found.omega_sigma
        ripple: Floats | float = 0.0
        if known.ripples:
            table = known.ripples[k]
            phase.omega[k, rows] = table.corrected(found.omega)
            phase.omega_sigma[k, rows] = table.corrected_sigma(found.omega, found.omega_sigma)
            ripple = table.expected_error(found.omega)
        phase.modulation[k, rows] = found.modulation
        phase.phase_error[k, rows] = found.phase_error
        phase.mean_intensity[rows] += found.mean_intensity / len(sequence.orientations_rad)
        reason[rows] |= _phase_reasons(found, ripple, measurement, parameters)


def _phase_reasons(
    found: PhaseGradient, ripple: Floats | float, measurement: Measurement, parameters: PhaseParameters
) -> Reasons:
    """Return the reasons for which the phases of one orientation are not to be trusted."""
    densities = sum(1 for t in measurement.sequence.densities if t)
    factors = np.array([phase_error_factor(n, parameters.kept_by_phase_error) for n in range(densities + 1)])
    reason = _noise_reasons(
        found.modulation,
        found.phase_error,
        factors[found.fitted],
        ripple,
        measurement.noise(found.mean_intensity),
        measurement.sequence.steps,
        parameters,
    )
    mark(reason, found.saturated, Reason.SATURATED)
    mark(reason, found.ambiguous, Reason.AMBIGUOUS_UNWRAPPING)
    return reason


def _noise_reasons(
    modulation: Singles,
    phase_error: Singles,
    factor: Floats | float,
    ripple: Floats | float,
    noise: Singles,
    steps: int,
    parameters: PhaseParameters,
) -> Reasons:
    """Return where the modulation is too low or the phase error above `factor` times that of noise.

    On top of it goes what the projector's `ripple` is known to make of it, in rad: however the two add up.
    """
    weakest = np.maximum(parameters.minimum_modulation_to_noise * noise, parameters.minimum_modulation_count)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = phase_sigma(noise, modulation, steps)
        limit = np.hypot(factor * sigma, parameters.maximum_phase_error_rad) + ripple
    reason = np.zeros(noise.shape, np.uint32)
    mark(reason, low_modulation(modulation, weakest), Reason.LOW_MODULATION)
    mark(reason, high_phase_error(phase_error, limit), Reason.HIGH_PHASE_ERROR)
    return reason


def _transfers(task: PhaseTask) -> list[Floats]:
    """Return the modulation transfer over the densities of each orientation, from a sample of the rows."""
    measurement, sequence = task.measurement, task.measurement.sequence
    frames, _ = in_best_exposure(measurement, sampled(measurement.frames, *_SAMPLED))
    return [
        transfer_of_sample(
            frames[sequence.frames_of(k)],
            sequence.densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            threads=task.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]


def _range_slab(
    task: PhaseTask,
    known: _Known,
    rows: slice,
    frames: Frames,
    phase: PhaseMaps,
    returns: ReturnMaps | None,
    reason: Reasons,
) -> None:
    """Fill the rows of `phase` and `returns` by ranging and the choice of a pair; mark bad ones."""
    measurement, parameters, sequence = task.measurement, task.parameters, task.measurement.sequence
    found = [
        range_returns(
            frames[sequence.frames_of(k)],
            sequence.densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            returns=parameters.returns,
            method=RANGING[parameters.method],
            refinements=parameters.refinements,
            joint=parameters.joint,
            window=parameters.window,
            significance=parameters.significance,
            mtf=known.transfers[k],
            threads=task.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]
    ripples: list[Floats | float] = [0.0] * len(found)
    for k, table in enumerate(known.ripples):
        measured = found[k].omega
        ripples[k] = table.expected_error(measured[0])
        sigma = table.corrected_sigma(measured, found[k].omega_sigma)
        found[k] = replace(found[k], omega=table.corrected(measured), omega_sigma=sigma)
    assert task.geometry is not None
    volume, densities = task.geometry.volume, np.array(sequence.densities, dtype=np.float64)
    pairing = task.geometry.pair.choose(
        rows,
        np.stack([f.omega for f in found]),
        np.stack([f.omega_sigma for f in found]),
        np.stack([f.amplitude for f in found]),
        low=volume.low,
        high=volume.high,
        gap_floor_mm=parameters.maximum_ray_gap_mm / parameters.maximum_ray_gap_to_noise,
        density_rms=float(np.sqrt(np.mean(densities**2))),
        least_gap=parameters.pair_rule == "least-gap",
    )
    phase.omega[:, rows] = pairing.omega
    merged = merged_sigma(
        [measurement.noise(f.mean_intensity) for f in found],
        pairing.amplitude,
        [f.amplitude for f in found],
        threshold=score_threshold(parameters.significance, len(densities)),
        densities=len(densities),
        steps=sequence.steps,
    )
    phase.omega_sigma[:, rows] = np.hypot(pairing.omega_sigma, merged)
    for k, one in enumerate(found):
        with np.errstate(divide="ignore", invalid="ignore"):
            error = phase_sigma(one.residual, pairing.amplitude[k], sequence.steps)
        phase.modulation[k, rows] = one.modulation
        phase.phase_error[k, rows] = error
        phase.mean_intensity[rows] += one.mean_intensity / len(found)
        freedom = 2 * len(sequence.densities) - 2 * parameters.returns + 1
        reason[rows] |= _noise_reasons(
            pairing.amplitude[k],
            error,
            phase_error_factor(freedom, parameters.kept_by_phase_error),
            ripples[k],
            measurement.noise(one.mean_intensity),
            sequence.steps,
            parameters,
        )
        mark(reason[rows], one.saturated, Reason.SATURATED)
        mark(reason[rows], (one.count == 0) & ~one.saturated, Reason.LOW_MODULATION)
    if parameters.pair_rule == "likelihood":
        mark(reason[rows], pairing.margin < parameters.minimum_pair_margin, Reason.AMBIGUOUS_PAIR)
    if returns is not None:
        returns.label[rows], returns.margin[rows] = pairing.label, pairing.margin
        for k, one in enumerate(found):
            returns.omega[k, :, rows] = one.omega
            returns.omega_sigma[k, :, rows] = one.omega_sigma
            returns.amplitude[k, :, rows] = one.amplitude


def mark(reason: Reasons, where: NDArray[np.bool_], why: Reason) -> None:
    """Add a reason to those of the pixels where it holds."""
    reason[where] |= np.uint32(why)


def sensor_pair(camera: Sensor, projector: Sensor, sequence: FringeSequence, threads: int) -> SensorPair:
    """Return a pair as its calibration says it stands."""
    return SensorPair(
        camera.intrinsics,
        camera.pose,
        camera.rows,
        camera.columns,
        Projector(projector.intrinsics, projector.pose, projector.columns, projector.rows),
        sequence.orientations_rad,
        threads,
    )
