"""Diagnose: the projector's response and the ripple that it causes, from the frames of one tuple.

Fringes tell their own waveform (see `metrology.phase.response`): no recording of its own is needed. A few
thousand pixels of some rows are enough, so this takes seconds whatever the size of the tuple.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sms_jobs.errors import MeasurementFailed
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
from sms_jobs.metrology.geometry.camera import ray_directions
from sms_jobs.metrology.geometry.triangulation import Projector, triangulate
from sms_jobs.metrology.phase.phase_stepping import phase_sigma
from sms_jobs.metrology.phase.response import Response, corrected_gradient, diagnose_response
from sms_jobs.metrology.phase.temporal_unwrapping import PhaseGradient, unwrap
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.diagnosis import ResponseDiagnosis
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.sensors import Calibration, split_pair

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

_LEAST_PIXELS = 100


class DiagnoseParameters(Parameters):
    """Which pixels are looked at, and what was sent to the projector."""

    visibility: float = Field(
        1.0, gt=0.0, le=1.0, description="visibility of the fringe patterns that were sent to the projector"
    )
    rows: int = Field(24, ge=1, description="rows of the image that are looked at, evenly spread")
    most_pixels: int = Field(20_000, ge=1000, description="pixels that are looked at, at most")
    minimum_modulation_to_noise: float = Field(
        20.0, gt=0.0, description="least fringe modulation in standard deviations of the camera's noise"
    )
    maximum_phase_error_to_noise: float = Field(
        4.0,
        gt=0.0,
        description="phase error, over that from noise, above which a pixel sees more than one surface",
    )
    maximum_phase_error_rad: float = Field(
        0.15,
        ge=0.0,
        description="phase error that is accepted on top of the noise: that of the ripple itself",
    )


@dataclass(frozen=True)
class _Sample:
    """Some rows of a recording: frames of the densities from 1 on, by orientation, and the rows' numbers."""

    picked: NDArray[np.int64]
    densities: tuple[int, ...]
    frames: list[NDArray[Any]]


def _needs(campaign: Campaign, subject: Subject) -> Iterable[Need]:
    yield Need("measurement", MEASUREMENT, subject)
    yield Need("calibration", CALIBRATION, subject)


def run(inputs: Inputs, parameters: DiagnoseParameters, progress: Progress) -> Iterator[Output]:
    """Find the response in each orientation's frames, and what its ripple does to the points."""
    measurement = inputs.read("measurement", "measurement", Measurement)
    calibration = inputs.read("calibration", "calibration", Calibration)
    sample = _sampled(measurement, parameters.rows)
    progress(0.5, "read some rows")
    found = [_unwrapped(measurement, sample, frames, inputs.threads) for frames in sample.frames]
    good = _thinned(_good(found, measurement, parameters), parameters.most_pixels)
    if good.sum() < _LEAST_PIXELS:
        raise MeasurementFailed(
            f"only {int(good.sum())} of the pixels looked at in {inputs.subject} have clear fringes, and "
            f"{_LEAST_PIXELS} are needed: look at more rows or lower minimum_modulation_to_noise"
        )
    steps = measurement.sequence.steps
    omega = np.stack([one.omega[good] for one in found])
    responses = [
        diagnose_response(frames[:, good], sample.densities, steps, gradient, parameters.visibility)
        for frames, gradient in zip(sample.frames, omega, strict=True)
    ]
    progress(0.9, "found the response")
    true = np.stack(
        [corrected_gradient(r, o, sample.densities, steps) for r, o in zip(responses, omega, strict=True)]
    )
    row, column = np.nonzero(good)
    pixels = np.stack([column.astype(np.float64), sample.picked[row].astype(np.float64)], axis=-1)
    moved = _moved(inputs.subject, calibration, measurement, pixels, omega, true)
    diagnosis = _diagnosis(inputs.subject, measurement, sample, responses, pixels, moved, omega - true)
    progress(1.0, "predicted the ripple")
    yield DatasetOutput(inputs.subject, {"response": diagnosis}, _statistics(diagnosis))


def _sampled(measurement: Measurement, rows: int) -> _Sample:
    sequence = measurement.sequence
    patterns = list(sequence.patterns())
    height = measurement.frames.shape[1]
    picked = np.unique(height * (2 * np.arange(rows) + 1) // (2 * rows))
    taken = np.concatenate([measurement.frames.rows(row, row + 1) for row in picked.tolist()], axis=1)
    frames = [
        taken[[i for i, (angle, t, _) in enumerate(patterns) if angle == orientation and t > 0]]
        for orientation in sequence.orientations_rad
    ]
    return _Sample(picked, tuple(t for t in sequence.densities if t > 0), frames)


def _unwrapped(
    measurement: Measurement, sample: _Sample, frames: NDArray[Any], threads: int
) -> PhaseGradient:
    return unwrap(
        frames,
        sample.densities,
        measurement.sequence.steps,
        full_scale=measurement.full_scale,
        gain=measurement.gain,
        read_noise=measurement.read_noise,
        threads=threads,
    )


def _good(found: list[PhaseGradient], measurement: Measurement, parameters: DiagnoseParameters) -> Flags:
    """Return the pixels with clear fringes of one surface and no saturated frame in every orientation."""
    good = np.ones(found[0].omega.shape, np.bool_)
    for one in found:
        noise = np.sqrt(measurement.read_noise**2 + measurement.gain * one.mean_intensity)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = phase_sigma(noise, one.modulation, measurement.sequence.steps)
            limit = np.hypot(
                parameters.maximum_phase_error_to_noise * sigma, parameters.maximum_phase_error_rad
            )
            good &= one.modulation > parameters.minimum_modulation_to_noise * noise
            good &= one.phase_error < limit
        good &= (one.fitted == one.fitted.max()) & ~one.ambiguous & np.isfinite(one.omega)
    return good


def _thinned(good: Flags, most: int) -> Flags:
    """Keep every n-th of the pixels, so that no more than `most` are left."""
    places = np.flatnonzero(good)
    kept = np.zeros(good.size, np.bool_)
    kept[places[:: -(-places.size // most) or 1]] = True
    return kept.reshape(good.shape)


def _moved(
    subject: Subject,
    calibration: Calibration,
    measurement: Measurement,
    pixels: Floats,
    omega: Floats,
    true: Floats,
) -> Floats:
    """Return by how much the ripple in omega moves the points of some pixels, (3, points) in mm."""
    camera, projector = (calibration.rig.sensor(name) for name in split_pair(subject.pair or ""))
    rays = np.ascontiguousarray(ray_directions(camera.intrinsics, camera.pose, pixels)[None])
    rays.setflags(write=False)  # as the table of a camera is: kernels are compiled for one kind of array
    model = Projector(projector.intrinsics, projector.pose, projector.columns, projector.rows)
    sigma = np.zeros((len(omega), 1, len(pixels)), np.float32)

    def met(gradients: Floats) -> Floats:
        orientations = measurement.sequence.orientations_rad
        return triangulate(
            camera.pose.centre(), rays, model, orientations, gradients[:, None], sigma
        ).xyz[:, 0]  # fmt: skip

    return met(omega) - met(true)


def _diagnosis(
    subject: Subject,
    measurement: Measurement,
    sample: _Sample,
    responses: list[Response],
    pixels: Floats,
    moved: Floats,
    ripple: Floats,
) -> ResponseDiagnosis:
    camera, projector = split_pair(subject.pair or "")
    return ResponseDiagnosis(
        camera,
        projector,
        measurement.sequence.orientations_rad,
        sample.densities,
        measurement.sequence.steps,
        responses[0].visibility,
        x=pixels[:, 0].copy(),
        y=pixels[:, 1].copy(),
        ripple=moved,
        ripple_omega=ripple,
        gamma=np.array([r.gamma for r in responses]),
        gamma_sigma=np.array([r.gamma_sigma for r in responses]),
        harmonics=np.stack([r.harmonics for r in responses]),
        harmonics_sigma=np.stack([r.sigma for r in responses]),
        damping=np.array([r.damping for r in responses]),
    )


def _statistics(diagnosis: ResponseDiagnosis) -> dict[str, float]:
    length = np.sqrt(np.sum(np.square(diagnosis.ripple), axis=0))
    return {
        "gamma": float(np.mean(diagnosis.gamma)),
        "second_harmonic": float(np.mean(diagnosis.harmonics[:, 1])),
        "ripple_rms_rad": float(np.sqrt(np.mean(np.square(diagnosis.ripple_omega)))),
        "ripple_rms_mm": float(np.sqrt(np.nanmean(np.square(length)))),
        "ripple_99_percent_mm": float(np.nanquantile(length, 0.99)),
    }


KIND = Kind(
    name="diagnose",
    summary="the projector's response, from the fringes themselves, and the ripple that it causes",
    version=1,
    scope=Scope.TUPLE,
    parameters=DiagnoseParameters,
    needs=_needs,
    run=run,
    in_pipeline=False,
)
