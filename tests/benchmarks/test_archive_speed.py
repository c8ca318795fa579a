"""How fast frames and fields are sealed and read; run with `pytest tests/benchmarks --benchmark-only`.

`extra_info` has MB of uncompressed data a second. Sealing includes hashing, forcing to the disk and reading
everything back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sms_jobs.archive import Archive, Provenance
from sms_jobs.records.campaign import Subject
from sms_jobs.records.fields import PointCloud
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement

ROWS, COLUMNS, FRAMES = 1024, 1280, 48
NOISE_COUNT = 12.0


def provenance(attempt: int) -> Provenance:
    when = datetime(2026, 1, 1, tzinfo=UTC)
    return Provenance(
        "speed", 1, Subject("speed", "S00", "C1P1"), "speed", attempt, when, {}, (), "0", "here", "me"
    )


def measurement(rng: np.random.Generator) -> Measurement:
    """Fringes on speckle with 12 bits and the noise of a real camera, which is what limits compression."""
    x = np.arange(COLUMNS)
    speckle = rng.random((ROWS, COLUMNS)) * 0.6 + 0.4
    frames = np.empty((FRAMES, ROWS, COLUMNS), np.uint16)
    for k in range(FRAMES):
        fringes = 1500.0 + 1200.0 * np.cos(2 * np.pi * (x * (32 - k // 4) / COLUMNS + k / 4))
        frames[k] = np.clip(speckle * fringes + rng.normal(0.0, NOISE_COUNT, speckle.shape), 0, 4095)
    return Measurement(
        datetime(2026, 1, 1, tzinfo=UTC), FringeSequence(), 4095, 0.1, 2.0, frames[0], ArrayStack(frames)
    )


def cloud(rng: np.random.Generator) -> PointCloud:
    image = (ROWS, COLUMNS)
    y, x = np.mgrid[0:ROWS, 0:COLUMNS]
    xyz = np.stack([0.3 * x, 0.3 * y, 50.0 * np.cos(x / 300.0)]) + rng.normal(0.0, 0.01, (3, *image))
    covariance = rng.normal(1e-4, 1e-6, (6, *image)).astype(np.float32)
    return PointCloud("C1", "P1", xyz, covariance, np.abs(covariance[0]) ** 0.5, np.zeros(image, np.uint32))


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive(tmp_path)


def timed(benchmark: Any, megabytes: float, work: Callable[[], object]) -> None:
    benchmark.pedantic(work, rounds=5, warmup_rounds=1)
    benchmark.extra_info["MB_per_s"] = round(megabytes / benchmark.stats.stats.median)


@pytest.mark.parametrize("make", [measurement, cloud])
def test_sealing(benchmark: Any, archive: Archive, rng: np.random.Generator, make: Any) -> None:
    record = make(rng)
    attempts: Iterator[int] = count(1)
    size = 2e-6 * FRAMES * ROWS * COLUMNS if make is measurement else 56e-6 * ROWS * COLUMNS
    timed(benchmark, size, lambda: archive.seal_dataset({"record": record}, provenance(next(attempts))))
    files = list(archive.root.rglob("*.h5"))
    benchmark.extra_info["ratio"] = round(size * 1e6 / files[0].stat().st_size, 2)


def test_reading_row_slabs_of_all_frames(benchmark: Any, archive: Archive, rng: np.random.Generator) -> None:
    sealed = archive.seal_dataset({"record": measurement(rng)}, provenance(1))

    def read() -> None:
        with archive.open(sealed.path) as dataset:
            frames = dataset.read("record", Measurement).frames
            for start in range(0, ROWS, 64):
                frames.rows(start, start + 64)

    timed(benchmark, 2e-6 * FRAMES * ROWS * COLUMNS, read)


def test_reading_fields(benchmark: Any, archive: Archive, rng: np.random.Generator) -> None:
    sealed = archive.seal_dataset({"record": cloud(rng)}, provenance(1))

    def read() -> None:
        with archive.open(sealed.path) as dataset:
            dataset.read("record", PointCloud)

    timed(benchmark, 56e-6 * ROWS * COLUMNS, read)


def test_reading_one_frame(benchmark: Any, archive: Archive, rng: np.random.Generator) -> None:
    sealed = archive.seal_dataset({"record": measurement(rng)}, provenance(1))
    with archive.open(sealed.path) as dataset:
        frames = dataset.read("record", Measurement).frames
        timed(benchmark, 2e-6 * ROWS * COLUMNS, lambda: frames.frame(7))
