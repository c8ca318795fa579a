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
error from 140 mm to 0.6 mm. Where one surface is seen beside another and both are lit there is no such gap,
and a pixel that sees both is told by its point, which lies between the two.

With Fourier domain ranging a pixel may have several returns. The pair of them that is light straight from the
projector is chosen slab by slab; what stays ambiguous is marked, see `metrology.geometry.ray_pairing`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from sms_jobs.kinds.calibration_factors import calibration_factor, median_part, position_sigma
from sms_jobs.kinds.kind import (
    CALIBRATION,
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Need,
    Output,
    Port,
    Progress,
    Scope,
    fringe_tuples,
)
from sms_jobs.kinds.products import (
    CALIBRATED,
    CALIBRATION_FACTOR,
    MEASURED,
    PHASE,
    RETURNS,
    SURFACE,
    UNCERTAINTY,
    Product,
)
from sms_jobs.kinds.shape.direction_check import check_directions
from sms_jobs.kinds.shape.fringe_response import SampledResponse
from sms_jobs.kinds.shape.phase_task import Geometry, PhaseParameters, PhaseTask
from sms_jobs.kinds.shape.phases import find_phases, sensor_pair
from sms_jobs.kinds.shape.ray_images import contradiction, gaps_missed, some_pixels, stated_by, told_by_rays
from sms_jobs.kinds.shape.trusted_points import (
    LARGEST_SHIFT_PX,
    as_surface,
    gap_sigma_px,
    mark_points,
    paired_sensors,
)
from sms_jobs.kinds.shape.watched_frames import OtherLight
from sms_jobs.kinds.valid_parts import fractions, losses
from sms_jobs.metrology.arrays import Mask, Reasons, Singles
from sms_jobs.metrology.calibration.checking.expected_gap import pixel_size
from sms_jobs.metrology.calibration.missed_rays import MissedRays
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.geometry.triangulation import Triangulation
from sms_jobs.metrology.phase.response import corrected_gradient
from sms_jobs.metrology.phase.texture_error import Blur, correct_texture
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import PhaseMaps, ReturnMaps
from sms_jobs.records.reasons import Reason
from sms_jobs.records.remarks import remarked
from sms_jobs.records.subject import Subject


class ReconstructParameters(PhaseParameters):
    """How phases become points, and which of them are trusted."""

    blur_px: float | None = Field(
        None,
        ge=0.0,
        description="standard deviation of the spot that a pixel sees, for the correction of the texture's "
        "error; found from the ray gaps if not given, 0 for no correction",
    )
    maximum_shift_px: float = Field(
        LARGEST_SHIFT_PX,
        gt=0.0,
        description="how far off its centre a pixel's light may come from: beyond is the edge of a surface",
    )


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,))
_CALIBRATION = Port("calibration", CALIBRATION, (CALIBRATED, UNCERTAINTY))

_TOLD_LAG, _TOLD_EXCESS = 0.005, 1.0
"""Of the light, and of the variance of noise, of which a remark is made."""
_MOST_APART = 0.75
"""Part of the points whose rays may miss each other without a remark."""


def _needs(campaign: Campaign, subject: Subject, parameters: ReconstructParameters) -> Iterable[Need]:
    yield _FRAMES.of(subject)
    yield _CALIBRATION.of(subject)


def run(inputs: Inputs, parameters: ReconstructParameters, progress: Progress) -> Iterator[Output]:
    """Unwrap and triangulate a tuple slab by slab, and say of every pixel whether it can be trusted."""
    measurement = inputs.read(_FRAMES, MEASURED)
    calibration = inputs.read(_CALIBRATION, CALIBRATED)
    camera, projector = paired_sensors(inputs, calibration, measurement)
    pair = sensor_pair(camera, projector, measurement.sequence, inputs.threads)
    geometry = Geometry(pair, calibration.volume, gap_sigma_px(inputs, _CALIBRATION, parameters, calibration))
    task = PhaseTask(inputs.subject, measurement, parameters, inputs.threads, geometry)
    found = find_phases(task, progress)
    phase, reason = found.maps, found.reason
    check_directions(inputs.subject, geometry, phase, reason == Reason.VALID)
    corrected = correct_texture(
        phase.omega,
        phase.omega_sigma,
        phase.modulation,
        reason == Reason.VALID,
        reason & Reason.LOW_MODULATION == 0,
        None if measurement.sequence.striped else pair.meet,
        blur_px=parameters.blur_px,
        maximum_shift_px=parameters.maximum_shift_px,
        threads=inputs.threads,
    )
    progress(0.9, "corrected for the texture")
    points = pair.meet(phase.omega, phase.omega_sigma, part=corrected.part)
    gap_px, missed = _missed(points, geometry, reason == Reason.VALID)
    mark_points(points, geometry, parameters, reason, corrected)
    surface = as_surface(str(inputs.view), points, reason)
    statistics = _statistics(points, phase, reason, corrected.blur)
    factor = calibration_factor(inputs, _CALIBRATION, calibration, measurement.sequence.orientations_rad)
    off_px = 0.0
    if missed is not None:
        factor = told_by_rays(factor, surface, gap_px, missed.scatter, [missed])
        off_px = missed.off_px
        statistics["epipolar_rms_px"] = gap_px
    surface = replace(surface, sigma_calibration=position_sigma(factor, surface))
    statistics |= stated_by(factor) | median_part(surface.sigma_calibration, "mm")
    records: dict[Product[Any], object] = {
        SURFACE: surface,
        PHASE: phase,
        CALIBRATION_FACTOR: factor,
    }
    told = (
        _told_of_gaps(reason),
        contradiction(factor, "the rays miss each other", "sensors", off_px),
        *_told_of_light(found.light),
    )
    progress(1.0, remarked("; ".join(filter(None, told)), beside="triangulated"))
    if found.returns is not None:
        records[RETURNS] = found.returns
        statistics |= _pair_statistics(reason, found.returns)
    if found.response is not None:
        statistics |= _response_statistics(found.response, measurement.sequence.steps)
    statistics |= _light_statistics(found.light)
    if phase.exposure is not None:
        statistics |= _exposure_statistics(phase.exposure, measurement.sequence.exposures)
    yield DatasetOutput(inputs.subject, records, statistics)


def _missed(points: Triangulation, geometry: Geometry, known: Mask) -> tuple[float, MissedRays | None]:
    """Return by how much the rays of pixels whose phases are `known` miss each other, in px of the projector.

    Robustly, and as a plane over the image; none where they cannot miss each other, or hardly any is known.
    Those that miss by too much must be among them: without these a plane is too flat.
    """
    if len(geometry.pair.orientations) < 2:
        return 0.0, None
    pixels, _ = some_pixels(known)
    columns, rows = pixels
    projector = geometry.pair.projector
    size = pixel_size((projector.intrinsics, projector.pose), points.xyz[:, rows, columns].T)
    gap_px = points.ray_gap[rows, columns] / size
    missed = gaps_missed(pixels, gap_px)
    return (0.0 if missed is None else 1.4826 * float(np.nanmedian(np.abs(gap_px)))), missed


def _told_of_gaps(reason: Reasons) -> str:
    """Return what it means that the rays of most points miss each other; empty where they do not."""
    lit = reason & Reason.LOW_MODULATION == 0
    apart = int(np.count_nonzero(lit & (reason & Reason.LARGE_RAY_GAP != 0)))
    part = apart / max(apart + int(np.count_nonzero(reason == Reason.VALID)), 1)
    if part <= _MOST_APART:
        return ""
    return (
        f"{part:.0%} of the rays miss each other: a sensor has moved since it was calibrated, or it is the "
        "calibration of another rig; what is left may be off as much, with too much noise to show it: "
        "calibrate again, or state by calibration_sigma_px how well the calibration is known"
    )


def _told_of_light(light: OtherLight) -> Iterator[str]:
    """Yield what is unusual about the light of the frames, and what was done about it."""
    lag, excess = light.lag, max(light.excess, default=0.0)
    if lag is not None and lag.part > _TOLD_LAG:
        yield (
            f"the frames hold {lag.part:.1%} of the light of the frame {lag.neighbour} each, which is taken "
            "out of the phases: let the projector settle longer (settle_ms of the rig), and see that "
            "exposures begin and end while one pattern is shown"
        )
    if excess > _TOLD_EXCESS:
        yield (
            f"phases scatter {np.sqrt(1.0 + excess):.1f} times as much as noise makes them, and so do all "
            "deviations: see if a lamp or the projector flickers or is not linear, and if gain and read "
            "noise are the camera's"
        )


def _light_statistics(light: OtherLight) -> dict[str, float]:
    """Return the same for people to search by; the part of the frame after is negative."""
    statistics = {}
    if light.lag is not None:
        statistics["frame_lag"] = light.lag.part if light.lag.neighbour == "before" else -light.lag.part
    if any(light.excess):
        statistics["phase_excess"] = max(light.excess)
    return statistics


def _statistics(points: Triangulation, phase: PhaseMaps, reason: Reasons, blur: Blur) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    valid = reason == Reason.VALID
    lit = (reason & (Reason.LOW_MODULATION | Reason.OUT_OF_VOLUME)) == 0
    statistics = {
        **fractions(valid, lit),
        **losses(reason),
        "blur_px": float(np.sqrt(blur.variance)),
    }
    if valid.any():
        sigma = np.sqrt(trace(points.covariance)[valid])
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "ray_gap_rms_mm": float(np.sqrt(np.mean(np.square(points.ray_gap[valid], dtype=np.float64)))),
            "median_modulation_count": float(np.median(phase.modulation[:, valid])),
        }
        error = phase.phase_error[:, valid]
        if np.isfinite(error).any():  # one density beside a Gray code has none
            statistics["median_phase_error_rad"] = float(np.nanmedian(error))
    return statistics


def _response_statistics(found: SampledResponse, steps: int) -> dict[str, float]:
    """Return what the projector's response is, and the ripple in omega that was taken out."""
    each = zip(found.responses, found.omega, strict=True)
    ripple = [o - corrected_gradient(response, o, found.densities, steps) for response, o in each]
    gamma = float(np.mean([response.gamma for response in found.responses]))
    return {
        "second_harmonic": float(np.mean([response.harmonics[1] for response in found.responses])),
        "corrected_ripple_rms_rad": float(np.sqrt(np.mean(np.square(ripple)))),
    } | ({"gamma": gamma} if np.isfinite(gamma) else {})


def _exposure_statistics(chosen: Singles, exposures: tuple[float, ...]) -> dict[str, float]:
    """Return which part of the pixels each exposure serves, the shortest first."""
    ordered = sorted(exposures)
    return {
        f"exposure_{n}_fraction": float(np.mean(chosen == np.float32(e))) for n, e in enumerate(ordered, 1)
    }


def _pair_statistics(reason: Reasons, returns: ReturnMaps) -> dict[str, float]:
    """Return how many of the pixels with a return have several, and how many of those are ambiguous."""
    found = returns.label > 0
    several = np.isfinite(returns.omega[:, 1]).any(axis=0)
    ambiguous = several & (reason & Reason.AMBIGUOUS_PAIR != 0)
    return {
        "several_returns_fraction": float(several.sum() / max(found.sum(), 1)),
        "ambiguous_pair_fraction": float(ambiguous.sum() / max(several.sum(), 1)),
    }


KIND = Kind(
    name="reconstruct",
    summary="shape from fringes: phase gradients, points, their covariance, and a reason for every gap",
    version=31,
    scope=Scope.TUPLE,
    parameters=ReconstructParameters,
    inputs=(_FRAMES, _CALIBRATION),
    outputs=(SURFACE, PHASE, RETURNS, CALIBRATION_FACTOR),
    needs=_needs,
    run=run,
    subjects=fringe_tuples,
)
