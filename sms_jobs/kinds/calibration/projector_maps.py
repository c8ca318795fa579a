"""Which projector pixel lit each camera pixel of a measurement, where that can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.kind import Progress
from sms_jobs.kinds.shape.phase_task import PhaseParameters, PhaseTask
from sms_jobs.kinds.shape.phases import find_phases
from sms_jobs.metrology.geometry.projector_pixels import projector_pixels
from sms_jobs.records.fields import PhaseMaps
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import SensorFormat
from sms_jobs.records.subject import Subject


@dataclass(frozen=True)
class ProjectorMaps:
    """Of every camera pixel.

    Attributes
    ----------
    phase
        What it was made of; omega is NaN where it cannot be trusted.
    pixel
        (2, rows, columns), x and y in projector pixels; NaN where the phase cannot be trusted.
    sigma
        (2, rows, columns), standard deviations of x and y in px.
    """

    phase: PhaseMaps
    pixel: NDArray[np.float64]
    sigma: NDArray[np.float32]


def projector_maps(
    subject: Subject, measurement: Measurement, projector: SensorFormat, threads: int, progress: Progress
) -> ProjectorMaps:
    """Unwrap a measurement slab by slab; no calibration is needed for that."""
    task = PhaseTask(subject, measurement, PhaseParameters(), threads)
    found = find_phases(task, progress)
    found.maps.omega[:, found.reason != Reason.VALID] = np.nan
    pixel, sigma = projector_pixels(
        found.maps.omega,
        found.maps.omega_sigma,
        measurement.sequence.orientations_rad,
        projector.columns,
        projector.rows,
    )
    return ProjectorMaps(found.maps, pixel, sigma)
