"""What two or three cameras record of a bent surface, and what stereo and correlate make of it."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import cache
from typing import Any

import numpy as np

from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters, Following
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Progress
from sms_jobs.kinds.shape import stereo
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.in_memory import InMemory, unheard
from support.two_cameras import VOLUME, Floats, Height, Motion, at_rest, cameras, curved, seen_by

AT = datetime(2026, 5, 4, tzinfo=UTC)
NOISE = 20.0


def bent(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    return 0.3 + 2e-3 * x, -0.1 - 5e-4 * y, 0.5 + 1.5 * np.cos(x / 60.0)


@cache
def exposed(number: int, count: int, height: Height, motion: Motion, seed: int) -> tuple[Measurement, Floats]:
    """Return what a camera of a rig records, with noise, and the points of its pixels."""
    seen = seen_by(cameras(count=count)[number], height, motion)
    random = np.random.default_rng((seed, number, motion is bent))
    return with_noise(seen.levels, random), seen.points


def with_noise(levels: Floats, random: np.random.Generator) -> Measurement:
    """Return a recording of grey levels, with noise."""
    noisy = levels + random.normal(0.0, NOISE, levels.shape)
    return recorded(np.clip(np.rint(noisy), 0, 4095).astype(np.uint16))


def recorded(levels: Any) -> Measurement:
    return Measurement(AT, FringeSequence(), 4095, 0.0, NOISE, levels, ArrayStack(levels[None]))


def calibration(count: int = 2, order: tuple[int, ...] = (0, 1, 2)) -> Calibration:
    rig = cameras(count=count)
    sensors = tuple(
        Sensor(f"C{k + 1}", Role.CAMERA, rig[n].columns, rig[n].rows, rig[n].intrinsics, rig[n].pose)
        for k, n in enumerate(order[:count])
    )
    return Calibration(Rig("two", sensors), Box(*VOLUME), AT, "exact")


def known(sigma_px: float) -> CalibrationUncertainty:
    """Return what a calibration says whose second camera's principal point alone is known so well."""
    covariance = np.zeros((2 * PER_SENSOR, 2 * PER_SENSOR))
    place = PER_SENSOR + SENSOR_PARAMETERS.index("cy")
    covariance[place, place] = sigma_px**2
    return CalibrationUncertainty(("C1", "C2"), SENSOR_PARAMETERS, covariance)


def surface_of(
    subject: Subject,
    images: list[Measurement],
    calibrated: Calibration,
    uncertainty: CalibrationUncertainty | None = None,
    progress: Progress = unheard,
    **parameters: Any,
) -> DatasetOutput:
    records: dict[str, Any] = {"calibration": calibrated}
    if uncertainty is not None:
        records["uncertainty"] = uncertainty
    datasets = {
        f"measurement {own}": InMemory(own, {"measurement": image})
        for own, image in zip(subject.recordings, images, strict=True)
    } | {"calibration": InMemory(subject, records)}
    (output,) = stereo.run(Inputs(subject, None, datasets), stereo.StereoParameters(**parameters), progress)
    assert isinstance(output, DatasetOutput)
    return output


@cache
def measured(
    motion: Motion, view: str = "C1C2", height: Height = curved, seed: int = 0
) -> tuple[DatasetOutput, Floats]:
    """Return the surface of a view of two or three cameras at a state, and the exact points."""
    subject = Subject("test", "S01" if motion is bent else "S00", view)
    count = len(subject.recordings)
    images = [exposed(k, count, height, motion, seed) for k in range(count)]
    return surface_of(subject, [m for m, _ in images], calibration(count)), images[0][1]


def scores(error: Floats, covariance: Any, reason: Any) -> Floats:
    """Return squared errors over their predicted variance, of the valid pixels."""
    valid = reason == Reason.VALID
    squared = np.sum(error[:, valid] ** 2, axis=0)
    return np.asarray(squared / covariance[[0, 3, 5]][:, valid].sum(axis=0, dtype=np.float64))


def two_states(view: str, height: Height = curved) -> dict[str, InMemory]:
    """Return what the displacement of two or three cameras is made of, from rest to what is bent."""
    before, after = (measured(motion, view, height)[0] for motion in (at_rest, bent))
    subject, at_start = (Subject("test", state, view) for state in ("S01", "S00"))
    count = len(subject.recordings)
    first, last = (exposed(0, count, height, motion, 0)[0] for motion in (at_rest, bent))
    datasets = {
        "calibration": InMemory(subject, {"calibration": calibration(count)}),
        "reference": InMemory(subject, before.records),
        "deformed": InMemory(subject, after.records),
        "reference_measurement": InMemory(subject, {"measurement": first}),
        "measurement": InMemory(subject, {"measurement": last}),
        "calibration_at_rest": InMemory(at_start, {"calibration": calibration(count)}),
    }
    for port, motion, about in (("reference_partner", at_rest, at_start), ("partner", bent, subject)):
        for k, own in enumerate(about.recordings[1:], start=1):
            seen, _ = exposed(k, count, height, motion, 0)
            datasets[f"{port} {own}"] = InMemory(own, {"measurement": seen})
    return datasets


def displaced(
    view: str, datasets: dict[str, InMemory], following: Following, progress: Progress = unheard
) -> DatasetOutput:
    """Return the displacement of a view."""
    inputs = Inputs(Subject("test", "S01", view), "S00", datasets)
    (output,) = correlate.run(inputs, CorrelateParameters(following=following), progress)
    assert isinstance(output, DatasetOutput)
    return output
