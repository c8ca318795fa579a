"""Diagnose: the projector's response and the ripple that it causes, from the frames of one tuple.

Fringes tell their own waveform (see `metrology.phase.response`): no recording of its own is needed. A few
thousand pixels of some rows are enough, so this takes seconds whatever the size of the tuple.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

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
from sms_jobs.kinds.products import CALIBRATED, MEASURED, RESPONSE
from sms_jobs.kinds.shape.foreign_patterns import refuse_foreign_patterns
from sms_jobs.kinds.shape.fringe_response import SampledResponse, SampleParameters, sampled_response
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import ray_directions
from sms_jobs.metrology.geometry.triangulation import Projector, triangulate
from sms_jobs.metrology.phase.response import corrected_gradient
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.diagnosis import ResponseDiagnosis
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of


class DiagnoseParameters(SampleParameters):
    """The sample that is looked at decides all: see `fringe_response`."""


_FRAMES = Port("measurement", MEASUREMENT, (MEASURED,))
_CALIBRATION = Port("calibration", CALIBRATION, (CALIBRATED,))


def _needs(campaign: Campaign, subject: Subject, parameters: DiagnoseParameters) -> Iterable[Need]:
    yield _FRAMES.of(subject)
    yield _CALIBRATION.of(subject)


def run(inputs: Inputs, parameters: DiagnoseParameters, progress: Progress) -> Iterator[Output]:
    """Find the response in each orientation's frames, and what its ripple does to the points."""
    measurement = inputs.read(_FRAMES, MEASURED)
    calibration = inputs.read(_CALIBRATION, CALIBRATED)
    refuse_foreign_patterns(inputs.subject, measurement, "method=temporal-unwrapping of reconstruct")
    sample = sampled_response(inputs.subject, measurement, parameters, inputs.threads)
    progress(0.9, "found the response")
    steps = measurement.sequence.steps
    true = np.stack(
        [
            corrected_gradient(response, omega, sample.densities, steps)
            for response, omega in zip(sample.responses, sample.omega, strict=True)
        ]
    )
    moved = _moved(inputs.subject, calibration, measurement, sample, true)
    diagnosis = _diagnosis(inputs.subject, measurement, sample, moved, sample.omega - true)
    progress(1.0, "predicted the ripple")
    yield DatasetOutput(inputs.subject, {RESPONSE: diagnosis}, _statistics(diagnosis))


def _moved(
    subject: Subject,
    calibration: Calibration,
    measurement: Measurement,
    sample: SampledResponse,
    true: Floats,
) -> Floats:
    """Return by how much the ripple in omega moves the points of some pixels, (3, points) in mm."""
    camera, projector = (calibration.rig.sensor(name) for name in view_of(subject.view).sensors)
    rays = np.ascontiguousarray(ray_directions(camera.intrinsics, camera.pose, sample.pixels)[None])
    rays.setflags(write=False)  # as the table of a camera is: kernels are compiled for one kind of array
    model = Projector(projector.intrinsics, projector.pose, projector.columns, projector.rows)
    sigma = np.zeros((len(true), 1, len(sample.pixels)), np.float32)

    def met(gradients: Floats) -> Floats:
        orientations = measurement.sequence.orientations_rad
        return triangulate(
            camera.pose.centre(), rays, model, orientations, gradients[:, None], sigma
        ).xyz[:, 0]  # fmt: skip

    return met(sample.omega) - met(true)


def _diagnosis(
    subject: Subject,
    measurement: Measurement,
    sample: SampledResponse,
    moved: Floats,
    ripple: Floats,
) -> ResponseDiagnosis:
    camera, projector = view_of(subject.view).sensors
    responses = sample.responses
    return ResponseDiagnosis(
        camera,
        projector,
        measurement.sequence.orientations_rad,
        sample.densities,
        measurement.sequence.steps,
        responses[0].visibility,
        x=sample.pixels[:, 0].copy(),
        y=sample.pixels[:, 1].copy(),
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
    version=3,
    scope=Scope.TUPLE,
    parameters=DiagnoseParameters,
    inputs=(_FRAMES, _CALIBRATION),
    outputs=(RESPONSE,),
    needs=_needs,
    run=run,
    subjects=fringe_tuples,
    in_pipeline=False,
)
