"""The archive: how fast frames are sealed, read in slabs, and verified."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from itertools import count
from statistics import median
from typing import TypeVar

import numpy as np

from sms_jobs.archive import Archive, FolderStore, Provenance, Sealed
from sms_jobs.bench.figures import REPEATS, Condition, Figure, Found, Group, Run
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.subject import Subject

T = TypeVar("T")

ROWS, COLUMNS, FRAMES = 1024, 1280, 48
_FRAMES_OF_50_MB = 19
_NOISE_COUNT = 12.0
_SLAB = 64
_AT = datetime(2026, 1, 1, tzinfo=UTC)


def _provenance(attempt: int) -> Provenance:
    return Provenance(
        "speed", 1, Subject("speed", "S00", "C1P1"), "speed", attempt, _AT, {}, (), "0", "here", "me"
    )


def _measurement(random: np.random.Generator, frames: int) -> Measurement:
    """Return fringes on speckle with 12 bits and a camera's noise, which is what limits compression."""
    x = np.arange(COLUMNS)
    speckle = random.random((ROWS, COLUMNS)) * 0.6 + 0.4
    made = np.empty((frames, ROWS, COLUMNS), np.uint16)
    for k in range(frames):
        fringes = 1500.0 + 1200.0 * np.cos(2 * np.pi * (x * (32 - k // 4) / COLUMNS + k / 4))
        made[k] = np.clip(speckle * fringes + random.normal(0.0, _NOISE_COUNT, speckle.shape), 0, 4095)
    return Measurement(_AT, FringeSequence(), 4095, 0.1, 2.0, made[0], ArrayStack(made))


def _cloud(random: np.random.Generator) -> Surface:
    image = (ROWS, COLUMNS)
    y, x = np.mgrid[0:ROWS, 0:COLUMNS]
    xyz = np.stack([0.3 * x, 0.3 * y, 50.0 * np.cos(x / 300.0)]) + random.normal(0.0, 0.01, (3, *image))
    covariance = random.normal(1e-4, 1e-6, (6, *image)).astype(np.float32)
    gap = np.abs(covariance[0]) ** 0.5
    return Surface("C1P1", "mm", xyz, np.zeros(image, np.uint32), covariance, gap)


def _seconds(work: Callable[[], T], tidy: Callable[[T], object] = lambda made: None) -> float:
    """Return the median wall time, after one call that does not count: disks and threads take part.

    What `work` returns is given to `tidy`, whose time does not count.
    """
    tidy(work())
    taken = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        made = work()
        taken.append(time.perf_counter() - started)
        tidy(made)
    return median(taken)


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    run.say("archive: sealing, reading and verifying frames")
    random = np.random.default_rng(20_031)
    archive = Archive(FolderStore(run.folder))
    record = _measurement(random, FRAMES // 4 if run.quick else FRAMES)
    small, cloud = _measurement(random, _FRAMES_OF_50_MB), _cloud(random)
    frames = record.frames.shape[0]
    size = 2e-6 * frames * ROWS * COLUMNS
    attempts = count(2)
    first = archive.seal_dataset({"record": record}, _provenance(1))
    fields = archive.seal_dataset({"record": cloud}, _provenance(next(attempts)))

    def seal(one: Measurement) -> Sealed:
        return archive.seal_dataset({"record": one}, _provenance(next(attempts)))

    def remove(sealed: Sealed) -> None:
        archive.discard(sealed.path)

    def read_slabs() -> None:
        with archive.open(first) as dataset:
            stack = dataset.read("record", Measurement).frames
            for start in range(0, ROWS, _SLAB):
                stack.rows(start, start + _SLAB)

    def read_frame() -> None:
        with archive.open(first) as dataset:
            dataset.read("record", Measurement).frames.frame(frames // 2)

    def read_fields() -> None:
        with archive.open(fields) as dataset:
            dataset.read("record", Surface)

    yield Figure("write_frames_mb_s", size / _seconds(lambda: seal(record), remove), "MB / s", 500.0)
    yield Figure("read_slab_mb_s", size / _seconds(read_slabs), "MB / s", 1400.0)
    yield Figure("read_frame_ms", 1e3 * _seconds(read_frame), "ms")
    yield Figure("read_fields_mb_s", 56e-6 * ROWS * COLUMNS / _seconds(read_fields), "MB / s")
    yield Figure("seal_50mb_ms", 1e3 * _seconds(lambda: seal(small), remove), "ms")
    taken = _seconds(lambda: archive.verify(first.path, first.content_hash))
    yield Figure("verify_mb_s", size / taken, "MB / s")
    yield Condition(
        "frames",
        f"{frames} frames of {COLUMNS} x {ROWS} px, 12 bits in uint16 with {_NOISE_COUNT:.0f} counts of "
        f"noise, {size:.0f} MB that take {first.size_bytes / 1e6:.0f} MB on the disk; MB of uncompressed "
        f"data per second of wall time, median of {REPEATS}, files just written and so in the "
        "system's cache; writing "
        "is sealing: compressed, hashed, forced to the disk, read back and renamed; slabs are of "
        f"{_SLAB} rows of all frames; 50 MB are {_FRAMES_OF_50_MB} frames; the target rates are those of "
        "the bare filters",
    )


GROUP = Group("archive", "sealing, reading and verifying frames", lambda: None, measure)
