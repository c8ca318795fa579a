"""Small records to be sealed, and what is left of them in an archive."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from sms_jobs.archive import Archive, InputReference, Provenance, Sealed
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.fields import Region, Regions, Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role

JOB = "0123456789abcdef"


def provenance(**changes: Any) -> Provenance:
    """Return where an example comes from."""
    made = Provenance(
        kind="example",
        kind_version=1,
        subject=Subject("test", "S00", "C1P1"),
        job_id=JOB,
        attempt=1,
        created_at=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
        parameters={"threshold": 0.5, "names": ["a", "b"]},
        inputs=(InputReference("measured", "measurement", "test/S00/C1P1/a.h5", "ab" * 32),),
        program_version="0.1.0",
        host="here",
        operator="Jürgen",
    )
    return replace(made, **changes)


def measurement(rng: np.random.Generator, rows: int = 150, columns: int = 90) -> Measurement:
    """Return a measurement of six frames of noise."""
    shape = (6, rows, columns)
    return Measurement(
        recorded_at=datetime(2026, 1, 2, tzinfo=UTC),
        sequence=FringeSequence(densities=(3, 2), steps=3, orientations_rad=(0.0,)),
        full_scale=4095,
        gain=0.1,
        read_noise=2.0,
        texture=rng.integers(0, 4096, shape[1:], dtype=np.uint16),
        frames=ArrayStack(rng.integers(0, 4096, shape, dtype=np.uint16)),
    )


def point_cloud(rng: np.random.Generator) -> Surface:
    """Return points of noise."""
    image = (40, 30)
    return Surface(
        view="C1P1",
        unit="mm",
        position=rng.normal(size=(3, *image)),
        covariance=rng.normal(size=(6, *image)).astype(np.float32),
        ray_gap=rng.normal(size=image).astype(np.float32),
        reason=np.zeros(image, np.uint32),
    )


def regions() -> Regions:
    """Return one region of nine pixels."""
    return Regions((Region(1, 9, (1.0, 1.0)),), np.ones((3, 3), np.int32))


def calibration() -> Calibration:
    """Return a rig of one camera."""
    pose = Pose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 500.0))
    sensor = Sensor("C1", Role.CAMERA, 90, 150, Intrinsics(100.0, 100.0, 44.5, 74.5), pose)
    return Calibration(
        Rig("rig", (sensor,)), Box((-1.0,) * 3, (1.0,) * 3), datetime(2026, 1, 1, tzinfo=UTC), "exact"
    )


def files_below(archive: Archive) -> list[str]:
    """Return every file of an archive, sorted."""
    return sorted(
        p.relative_to(archive.store.root).as_posix() for p in archive.store.root.rglob("*") if p.is_file()
    )


def damaged(archive: Archive, sealed: Sealed, change: Any) -> None:
    """Put other bytes in the place of a sealed file's."""
    path = archive.store.path(sealed.path)
    data = bytearray(path.read_bytes())
    path.chmod(0o644)
    path.write_bytes(change(data))
