"""The small plate at rest as codes measure it: rendered, reconstructed, and how far off it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape

SUBJECT = Subject("plate", "S00", "C1P1")
Seen: TypeAlias = tuple[Calibration, Measurement, Shape]


def simulated(
    sequence: FringeSequence,
    camera: Mapping[str, Any] | None = None,
    projector: Mapping[str, Any] | None = None,
) -> Seen:
    """Render the plate with other values of what camera and projector do to light."""
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    scene = replace(
        campaign.scene,
        camera=replace(campaign.scene.camera, **(camera or {})),
        projector=replace(campaign.scene.projector, **(projector or {})),
    )
    simulation = Simulation(scene, "C1", "P1", (), state="S00")
    seen = render(simulation, sequence)
    frames = ArrayStack(seen.frames.rows(0, seen.frames.shape[1]))
    measurement = Measurement(
        calibration.valid_from, sequence, seen.full_scale, seen.gain, seen.read_noise, seen.texture, frames
    )
    return calibration, measurement, exact_shape(simulation)


def reconstructed(calibration: Calibration, measurement: Measurement, **parameters: object) -> Surface:
    """Return the shape that the job finds."""
    records = {"measurement": measurement, "calibration": calibration}
    given = ReconstructParameters.model_validate(parameters)
    surface = run_kind(KIND, SUBJECT, records, 1, given).records["surface"]
    assert isinstance(surface, Surface)
    return surface


def in_sigmas(surface: Surface, shape: Shape) -> NDArray[np.float64]:
    """Return the errors in Z of valid pixels, 3 px inside what is lit, in their standard deviations."""
    inside = (surface.reason == Reason.VALID) & ndimage.binary_erosion(shape.lit, iterations=3)
    error = (surface.position[2] - shape.xyz[2]) / np.sqrt(surface.covariance[5])
    return np.asarray(error[inside])
