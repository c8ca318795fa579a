"""Stereo fringes: from fringes that two cameras see to points, by the calibration of the cameras alone.

Where both cameras see the same two phases they see one point of the surface, wherever the projector stands
and however its lens bends: it only marks points, as a texture does, but each pixel by itself and on plain
surfaces too. A point is the depth along the reference camera's ray whose image in the other camera is the
nearest to the place with its phases; what is left across the image of that ray is the gap that tells a wrong
one.

The phases of the other camera are known at its pixels, and looked up between them on parabolas through nine.
That averages their noise, which neighbours then share: it is stated as of single pixels, so that means over
many pixels have the noise that is stated of them, and a single point a seventh less than it states.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field

from sms_jobs.errors import InvalidInput, MeasurementFailed
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
    stereo_fringe_tuples,
)
from sms_jobs.kinds.products import (
    CALIBRATED,
    CALIBRATION_FACTOR,
    MEASURED,
    PHASE,
    SURFACE,
    UNCERTAINTY,
    Product,
)
from sms_jobs.kinds.shape.phase_task import Geometry, PhaseParameters, PhaseTask, TrustParameters, mark
from sms_jobs.kinds.shape.phases import Phases, find_phases, sensor_pair
from sms_jobs.kinds.shape.ray_images import gaps_missed, lines_summary, some_pixels, stated_by, told_by_rays
from sms_jobs.kinds.shape.shared_fringes import MetFringes, SeenFringes, SharedFringes
from sms_jobs.kinds.shape.trusted_points import LARGEST_SHIFT_PX, as_surface, gap_sigma_px, mark_points
from sms_jobs.kinds.valid_parts import fractions, losses
from sms_jobs.metrology.arrays import Floats, Reasons
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import PhaseMaps, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Calibration, Sensor
from sms_jobs.records.subject import Subject

_OF_PHASES = 0.35
"""Of the work, for each camera."""
_EXCHANGED = 5.0
"""How much better cameras the other way round have to explain the places to be believed."""
_CLOSE_PX = 0.1
"""Median distance of places from the images of their rays that needs no other explanation."""


class StereoFringesParameters(TrustParameters):
    """Which phases and points are trusted."""

    blur_px: float | None = Field(
        None,
        ge=0.0,
        description="standard deviation of the spot that a pixel sees, of both cameras, for the corrections "
        "of texture and bend; found from the phases of each if not given, 0 for no correction",
    )
    maximum_shift_px: float = Field(
        LARGEST_SHIFT_PX,
        gt=0.0,
        description="how far off its centre a pixel's light may come from: beyond is the edge of a surface",
    )
    maximum_epipolar_px: float = Field(
        1.0,
        gt=0.0,
        description="largest median distance of places from the images of their rays: beyond, the "
        "calibration is not that of these frames",
    )


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,), several=True)
_CALIBRATION = Port("calibration", CALIBRATION, (CALIBRATED, UNCERTAINTY))


def _needs(campaign: Campaign, subject: Subject, parameters: StereoFringesParameters) -> Iterable[Need]:
    yield from map(_FRAMES.of, subject.recordings)
    yield _CALIBRATION.of(subject)


def run(inputs: Inputs, parameters: StereoFringesParameters, progress: Progress) -> Iterator[Output]:
    """Find the phases of both cameras, look up those of the reference in the other, and meet the rays."""
    calibration = inputs.read(_CALIBRATION, CALIBRATED)
    recorded = inputs.subject.recordings
    measured = [inputs.read(_FRAMES, MEASURED, own) for own in recorded]
    each = zip(inputs.view.triangulating, recorded, measured, strict=True)
    camera, partner = (_camera(calibration, *one) for one in each)
    _require_alike(inputs.subject, measured)
    pair = sensor_pair(camera, partner, measured[0].sequence, inputs.threads)
    geometry = Geometry(pair, calibration.volume, gap_sigma_px(inputs, _CALIBRATION, parameters, calibration))
    own, other = (
        SeenFringes.of(
            _phases(one, frames, parameters, inputs.threads, _part_of(progress, n)), inputs.threads
        )
        for n, (one, frames) in enumerate(zip(recorded, measured, strict=True))
    )
    progress(2 * _OF_PHASES, f"looking up the phases of {recorded[0].view} in {recorded[1].view}")
    fringes, reason = SharedFringes(pair, own, other), own.reason
    met = fringes.points(parameters.blur_px, parameters.maximum_shift_px)
    epipolar = _refuse_far_from_rays(inputs, fringes, met, parameters.maximum_epipolar_px)
    unseen = fringes.usable & np.isnan(met.points.xyz[0])
    mark(reason, unseen, Reason.NO_MATCH)
    mark_points(met.points, geometry, parameters, reason, met.corrected)
    reason[unseen] &= ~np.uint32(Reason.OUT_OF_VOLUME)  # nobody knows where it is
    surface = as_surface(str(inputs.view), met.points, reason)
    statistics = _statistics(surface, own.maps, epipolar)
    statistics["blur_px"] = float(np.sqrt(met.corrected.blur.variance))
    pixels, some = some_pixels(fringes.usable)
    missed = gaps_missed(pixels, met.gap_px[some])
    noise_px = 0.0 if missed is None else missed.scatter
    factor = calibration_factor(inputs, _CALIBRATION, calibration)
    factor = told_by_rays(factor, surface, epipolar, noise_px, [missed])
    surface = replace(surface, sigma_calibration=position_sigma(factor, surface))
    statistics |= stated_by(factor) | median_part(surface.sigma_calibration, "mm")
    records: dict[Product[Any], object] = {
        SURFACE: surface,
        PHASE: own.maps,
        CALIBRATION_FACTOR: factor,
    }
    progress(1.0, lines_summary(factor, epipolar, noise_px))
    yield DatasetOutput(inputs.subject, records, statistics)


def _camera(calibration: Calibration, name: str, recorded: Subject, measurement: Measurement) -> Sensor:
    """Return a camera of the view; `InvalidInput` where it is not calibrated, or for other images."""
    camera = calibration.rig.sensor(name)
    _, rows, columns = measurement.frames.shape
    if (rows, columns) != (camera.rows, camera.columns):
        raise InvalidInput(
            f"the frames of {recorded} are {columns} x {rows} px but {name} is calibrated for "
            f"{camera.columns} x {camera.rows} px: choose the calibration of the camera that recorded them"
        )
    return camera


def _require_alike(subject: Subject, measured: list[Measurement]) -> None:
    """Raise `InvalidInput` for fringes that do not give each point of a surface phases of its own."""
    first, second = (one.sequence for one in measured)
    if first.orientations_rad != second.orientations_rad:
        raise InvalidInput(
            f"the cameras of {subject} saw fringes of different orientations: record or import both with one "
            "sequence"
        )
    if len(first.orientations_rad) < 2:
        raise InvalidInput(
            f"{subject} has fringes of one orientation, by which nothing tells a wrong point: record two, or "
            "calibrate the projector and measure with a view of one camera"
        )
    if first.striped or second.striped:
        raise InvalidInput(
            f"{subject} was recorded with stripes alone, whose steps tell no part of a pixel: add fringes"
        )


def _part_of(progress: Progress, number: int) -> Progress:
    """Return what tells the progress of a camera's phases."""
    return lambda fraction, message="": progress(_OF_PHASES * (number + fraction), message)


def _phases(
    recorded: Subject, measurement: Measurement, trusted: TrustParameters, threads: int, progress: Progress
) -> Phases:
    """Return the phases that a camera sees."""
    known = trusted.model_dump(include=set(TrustParameters.model_fields))
    return find_phases(PhaseTask(recorded, measurement, PhaseParameters(**known), threads), progress)


def _refuse_far_from_rays(inputs: Inputs, fringes: SharedFringes, met: MetFringes, most_px: float) -> float:
    """Return the rms distance of places from the images of their rays, in px, robustly.

    Raises `MeasurementFailed` where it is so large that the calibration is not theirs, where the cameras fit
    better the other way round, and where they see nothing together.
    """
    names = " and ".join(inputs.view.triangulating)
    seen = np.isfinite(met.place).all(axis=0)
    if not seen.any():
        raise MeasurementFailed(
            f"{names} see no point of the fringes together: what they see of the projector's light does not "
            "overlap, or they are of different recordings"
        )
    middle = _middle(met.gap_px[seen])
    if middle > _CLOSE_PX:
        swapped = _middle(fringes.gaps_exchanged_px(met.place)[seen])
        if _EXCHANGED * swapped < middle:
            raise MeasurementFailed(
                f"the fringes that {names} see lie {_px(middle)} beside the images of their rays, and "
                f"{_px(swapped)} with the two swapped: import the frames or the calibration again with "
                "the cameras in the other order"
            )
    if middle > most_px:
        raise MeasurementFailed(
            f"the fringes that {names} see lie {_px(middle)} (median) beside the images of their rays, and "
            f"maximum_epipolar_px allows {most_px:g}: the calibration is not that of these frames, or the "
            "cameras, the projector or the specimen have moved between them"
        )
    return 1.4826 * middle


def _middle(gap_px: Floats) -> float:
    """Return the median length of gaps; rays that nowhere come near each other are infinitely far apart."""
    return float(np.median(np.nan_to_num(np.abs(gap_px), nan=np.inf)))


def _px(length: float) -> str:
    return f"{length:.2g} px" if np.isfinite(length) else "nowhere near"


def _statistics(surface: Surface, phase: PhaseMaps, epipolar_px: float) -> dict[str, float]:
    """Return what people search by; where nothing is valid, only the fractions."""
    reason: Reasons = surface.reason
    valid = reason == Reason.VALID
    lit = (reason & (Reason.LOW_MODULATION | Reason.OUT_OF_VOLUME)) == 0
    statistics = {**fractions(valid, lit), **losses(reason), "epipolar_rms_px": epipolar_px}
    if valid.any() and surface.covariance is not None and surface.ray_gap is not None:
        sigma = np.sqrt(trace(surface.covariance)[valid])
        gap = surface.ray_gap[valid].astype(np.float64)
        statistics |= {
            "median_sigma_mm": float(np.median(sigma)),
            "ray_gap_rms_mm": float(np.sqrt(np.mean(gap**2))),
            "median_modulation_count": float(np.median(phase.modulation[:, valid])),
        }
    return statistics


KIND = Kind(
    name="stereo-fringes",
    summary="shape from fringes that two cameras see, by their calibration alone: phases looked up, rays met",
    version=8,
    scope=Scope.TUPLE,
    parameters=StereoFringesParameters,
    inputs=(_FRAMES, _CALIBRATION),
    outputs=(SURFACE, PHASE, CALIBRATION_FACTOR),
    needs=_needs,
    run=run,
    subjects=stereo_fringe_tuples,
)
