"""Reconstruct: from the frames of one tuple to a point, its covariance and a reason for every pixel.

The default thresholds are in units of the noise that the camera's model predicts, so that they fit any
exposure. At a modulation of 5 sigma a phase scatters by 0.14 rad, and a step of the fringe orders of the
reverse exponential sequence by 0.35 rad, far from a half fringe. The phase error of a good pixel follows a
chi-square law, of which 99.9 % is kept for each orientation; a pixel that sees two surfaces has phases that
are not proportional to the density and fails. On the virtual top hat more than 98 % of the pixels that are
seen and lit pass all tests.

The outermost pixels of what passes are given up besides: their light comes in part from beside the surface,
and where a camera's centre ray just misses a lit edge they show a point of the wrong surface with all the
signs of a good one. On the virtual top hat of 512 px this costs 2-4 % of the pixels and takes the largest
error from 140 mm to 0.6 mm.

With Fourier domain ranging a pixel may have several returns. The pair of them that is light straight from the
projector is chosen slab by slab; what cannot be told is marked, see `metrology.geometry.ray_pairing`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Parameters,
    Progress,
    Scope,
)
from sms_jobs.kinds.streaming import row_slabs, sampled
from sms_jobs.metrology.geometry.sensor_pair import SensorPair
from sms_jobs.metrology.geometry.triangulation import Projector, Triangulation
from sms_jobs.metrology.images.masks import (
    at_edge,
    high_phase_error,
    large_ray_gap,
    low_modulation,
    outside_box,
    phase_error_factor,
)
from sms_jobs.metrology.phase.fourier_domain_ranging import range_returns, score_threshold
from sms_jobs.metrology.phase.fringe_blur import transfer_of_sample
from sms_jobs.metrology.phase.merged_returns import merged_sigma
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.returns_signal import Window
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.metrology.phase.texture_error import Blur, correct_texture
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.fields import PhaseMaps, PointCloud, ReturnMaps
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, Role, Sensor, split_pair

_SAMPLED = (4, 512)  # rows, and pixels of each, that tell the modulation transfer

# Of good pixels 0.2 % fail by noise: four that touch each other do so once in many million images.
_SMALLEST_GAP = 4

Reasons = NDArray[np.uint32]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Frames = NDArray[Any]

Method = Literal["temporal-unwrapping", "fdr", "fdr-improved", "fdr-original"]
UNWRAPPING: Method = "temporal-unwrapping"
RANGING: dict[str, Any] = {
    "fdr": "known-origin",
    "fdr-improved": "improved",
    "fdr-original": "original",
}
"""What the ranging methods are called where they are described."""


class ReconstructParameters(Parameters):
    """How phases become points, and which of them are trusted."""

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
    blur_px: float | None = Field(
        None,
        ge=0.0,
        description="standard deviation of the spot that a pixel sees, for the correction of the texture's "
        "error; found from the ray gaps if not given, 0 for no correction",
    )
    maximum_shift_px: float = Field(
        0.5,
        gt=0.0,
        description="how far off its centre a pixel's light may come from: beyond is the edge of a surface",
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

    @field_validator("returns")
    @classmethod
    def _have_a_method(cls, returns: int, given: ValidationInfo) -> int:
        if returns > 1 and given.data.get("method") == UNWRAPPING:
            raise ValueError(
                "temporal unwrapping knows one return only; set method=fdr to tell several apart"
            )
        return returns


def _needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    yield Need("measurement", MEASUREMENT, subject)
    yield Need("calibration", CALIBRATION, subject)


def run(inputs: Inputs, parameters: ReconstructParameters, progress: Progress) -> Iterator[Output]:
    """Unwrap and triangulate a tuple slab by slab, and say of every pixel whether it can be trusted."""
    measurement = inputs.read("measurement", "measurement", Measurement)
    calibration = inputs.read("calibration", "calibration", Calibration)
    camera_name, projector_name = split_pair(inputs.subject.pair or "")
    camera = calibration.rig.sensor(camera_name)
    projector = calibration.rig.sensor(projector_name)
    if (camera.role, projector.role) != (Role.CAMERA, Role.PROJECTOR):
        raise InvalidInput(
            f"{inputs.subject} is not of a camera and a projector of rig {calibration.rig.name}"
        )
    _, rows, columns = measurement.frames.shape
    if (rows, columns) != (camera.rows, camera.columns):
        raise InvalidInput(
            f"the frames of {inputs.subject} are {columns} x {rows} px but {camera_name} is calibrated for "
            f"{camera.columns} x {camera.rows} px: choose the calibration of the camera that recorded them"
        )
    pair = _sensor_pair(camera, projector, measurement.sequence, inputs.threads)
    task = _Task(measurement, calibration, parameters, pair)
    phase, returns, reason = _phases(task, progress)
    blur, beside = correct_texture(
        phase.omega,
        phase.omega_sigma,
        phase.modulation,
        reason == Reason.VALID,
        pair.meet,
        blur_px=parameters.blur_px,
        maximum_shift_px=parameters.maximum_shift_px,
        threads=inputs.threads,
    )
    _mark(reason, beside, Reason.OUTSIDE_REGION)
    progress(0.9, "corrected for the texture")
    points = pair.meet(phase.omega, phase.omega_sigma)
    _mark_points(points, calibration, parameters, reason)
    cloud = _as_cloud(camera_name, projector_name, points, reason)
    progress(1.0, "triangulated")
    statistics = _statistics(cloud, phase, blur)
    records: dict[str, object] = {"cloud": cloud, "phase": phase}
    if returns is not None:
        records["returns"] = returns
        statistics |= _pair_statistics(cloud, returns)
    yield DatasetOutput(inputs.subject, records, statistics)


@dataclass(frozen=True)
class _Task:
    """What the frames of a slab are turned into phases with."""

    measurement: Measurement
    calibration: Calibration
    parameters: ReconstructParameters
    pair: SensorPair


def _sensor_pair(camera: Sensor, projector: Sensor, sequence: FringeSequence, threads: int) -> SensorPair:
    return SensorPair(
        camera.intrinsics,
        camera.pose,
        camera.rows,
        camera.columns,
        Projector(projector.intrinsics, projector.pose, projector.columns, projector.rows),
        sequence.orientations_rad,
        threads,
    )


def _phases(task: _Task, progress: Progress) -> tuple[PhaseMaps, ReturnMaps | None, Reasons]:
    """Return the phases of a tuple, its returns if there can be several, and the pixels not to be trusted."""
    measurement, parameters = task.measurement, task.parameters
    _, rows, columns = measurement.frames.shape
    phase = PhaseMaps.unset(measurement.sequence.orientations_rad, rows, columns)
    reason = np.zeros((rows, columns), np.uint32)
    returns = None
    if parameters.returns > 1:
        orientations = measurement.sequence.orientations_rad
        returns = ReturnMaps.unset(orientations, parameters.returns, rows, columns)
    transfers = [] if parameters.method == UNWRAPPING else _transfers(task)
    for slab, frames in row_slabs(measurement.frames, task.pair.threads):
        if parameters.method == UNWRAPPING:
            _unwrap_slab(task, slab, frames, phase, reason)
        else:
            _range_slab(task, transfers, slab, frames, phase, returns, reason)
        del frames  # before the next slab is asked for: two of them are in memory, not three
        progress(0.8 * slab.stop / rows, f"found phases in {slab.stop} of {rows} rows")
    return phase, returns, reason


def _unwrap_slab(task: _Task, rows: slice, frames: Frames, phase: PhaseMaps, reason: Reasons) -> None:
    """Fill the rows of `phase` and mark those pixels in `reason` whose phase cannot be trusted."""
    measurement, parameters = task.measurement, task.parameters
    sequence = measurement.sequence
    densities = tuple(t for t in sequence.densities if t)
    for k in range(len(sequence.orientations_rad)):
        found = unwrap(
            frames[sequence.frames_of(k, uniform=False)],
            densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            threads=task.pair.threads,
        )
        phase.omega[k, rows] = found.omega
        phase.omega_sigma[k, rows] = found.omega_sigma
        phase.modulation[k, rows] = found.modulation
        phase.phase_error[k, rows] = found.phase_error
        phase.mean_intensity[rows] += found.mean_intensity / len(sequence.orientations_rad)
        reason[rows] |= _phase_reasons(found, measurement, parameters)


def _phase_reasons(
    found: PhaseGradient, measurement: Measurement, parameters: ReconstructParameters
) -> Reasons:
    """Return the reasons for which the phases of one orientation are not to be trusted."""
    densities = sum(1 for t in measurement.sequence.densities if t)
    factors = np.array([phase_error_factor(n, parameters.kept_by_phase_error) for n in range(densities + 1)])
    reason = _noise_reasons(
        found.modulation,
        found.phase_error,
        factors[found.fitted],
        measurement.noise(found.mean_intensity),
        measurement.sequence.steps,
        parameters,
    )
    _mark(reason, found.saturated, Reason.SATURATED)
    _mark(reason, found.ambiguous, Reason.AMBIGUOUS_UNWRAPPING)
    return reason


def _noise_reasons(
    modulation: Singles,
    phase_error: Singles,
    factor: Floats | float,
    noise: Singles,
    steps: int,
    parameters: ReconstructParameters,
) -> Reasons:
    """Return where the modulation is too low or the phase error above `factor` times that of noise."""
    weakest = np.maximum(parameters.minimum_modulation_to_noise * noise, parameters.minimum_modulation_count)
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = phase_sigma(noise, modulation, steps)
        limit = np.hypot(factor * sigma, parameters.maximum_phase_error_rad)
    reason = np.zeros(noise.shape, np.uint32)
    _mark(reason, low_modulation(modulation, weakest), Reason.LOW_MODULATION)
    _mark(reason, high_phase_error(phase_error, limit), Reason.HIGH_PHASE_ERROR)
    return reason


def _transfers(task: _Task) -> list[Floats]:
    """Return the modulation transfer over the densities of each orientation, from a sample of the rows."""
    measurement, sequence = task.measurement, task.measurement.sequence
    frames = sampled(measurement.frames, *_SAMPLED)
    return [
        transfer_of_sample(
            frames[sequence.frames_of(k)],
            sequence.densities,
            sequence.steps,
            full_scale=measurement.full_scale,
            gain=measurement.gain,
            read_noise=measurement.read_noise,
            threads=task.pair.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]


def _range_slab(
    task: _Task,
    transfers: list[Floats],
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
            mtf=transfers[k],
            threads=task.pair.threads,
        )
        for k in range(len(sequence.orientations_rad))
    ]
    volume, densities = task.calibration.volume, np.array(sequence.densities, dtype=np.float64)
    pairing = task.pair.choose(
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
            measurement.noise(one.mean_intensity),
            sequence.steps,
            parameters,
        )
        _mark(reason[rows], one.saturated, Reason.SATURATED)
        _mark(reason[rows], (one.count == 0) & ~one.saturated, Reason.LOW_MODULATION)
    if parameters.pair_rule == "likelihood":
        _mark(reason[rows], pairing.margin < parameters.minimum_pair_margin, Reason.AMBIGUOUS_PAIR)
    if returns is not None:
        returns.label[rows], returns.margin[rows] = pairing.label, pairing.margin
        for k, one in enumerate(found):
            returns.omega[k, :, rows] = one.omega
            returns.omega_sigma[k, :, rows] = one.omega_sigma
            returns.amplitude[k, :, rows] = one.amplitude


def _mark(reason: Reasons, where: NDArray[np.bool_], why: Reason) -> None:
    reason[where] |= np.uint32(why)


def _mark_points(
    points: Triangulation, calibration: Calibration, parameters: ReconstructParameters, reason: Reasons
) -> None:
    """Mark the pixels whose point cannot be trusted; one whose rays do not meet at all is out of volume."""
    outside = outside_box(points.xyz, calibration.volume.low, calibration.volume.high)
    nowhere = np.isnan(points.xyz[0]) & (reason & Reason.SATURATED == 0)
    _mark(reason, outside | nowhere, Reason.OUT_OF_VOLUME)
    apart = large_ray_gap(
        points.ray_gap,
        points.ray_gap_sigma,
        parameters.maximum_ray_gap_mm,
        parameters.maximum_ray_gap_to_noise,
    )
    _mark(reason, apart, Reason.LARGE_RAY_GAP)
    _mark(reason, at_edge(reason == Reason.VALID, _SMALLEST_GAP), Reason.OUTSIDE_REGION)


def _as_cloud(camera: str, projector: str, points: Triangulation, reason: Reasons) -> PointCloud:
    """Return the point cloud, NaN where there is a reason."""
    bad = reason != Reason.VALID
    for values in (points.xyz, points.covariance, points.ray_gap[None]):
        values[:, bad] = np.nan
    return PointCloud(camera, projector, points.xyz, points.covariance, points.ray_gap, reason)


def _statistics(cloud: PointCloud, phase: PhaseMaps, blur: Blur) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = cloud.reason == Reason.VALID
    bright = (cloud.reason & (Reason.LOW_MODULATION | Reason.OUT_OF_VOLUME)) == 0
    statistics = {
        "valid_fraction": float(valid.mean()),
        "valid_fraction_of_lit": float(valid.sum() / max(bright.sum(), 1)),
        "blur_px": float(np.sqrt(blur.variance)),
    }
    if valid.any():
        sigma = np.sqrt(cloud.covariance[[0, 3, 5]][:, valid].sum(axis=0))
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "ray_gap_rms_mm": float(np.sqrt(np.mean(np.square(cloud.ray_gap[valid], dtype=np.float64)))),
            "median_modulation_count": float(np.median(phase.modulation[:, valid])),
            "median_phase_error_rad": float(np.nanmedian(phase.phase_error[:, valid])),
        }
    return statistics


def _pair_statistics(cloud: PointCloud, returns: ReturnMaps) -> dict[str, float]:
    """Return how many of the pixels with a return have several, and how many of those are ambiguous."""
    found = returns.label > 0
    several = np.isfinite(returns.omega[:, 1]).any(axis=0)
    ambiguous = several & (cloud.reason & Reason.AMBIGUOUS_PAIR != 0)
    return {
        "several_returns_fraction": float(several.sum() / max(found.sum(), 1)),
        "ambiguous_pair_fraction": float(ambiguous.sum() / max(several.sum(), 1)),
    }


KIND = Kind(
    name="reconstruct",
    summary="shape from fringes: phase gradients, points, their covariance, and a reason for every gap",
    version=3,
    scope=Scope.TUPLE,
    parameters=ReconstructParameters,
    needs=_needs,
    run=run,
)
