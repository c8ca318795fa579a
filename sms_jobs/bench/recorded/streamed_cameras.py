"""Two cameras of a megapixel at a rate: to the spool, and from there to the archive."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.bench.groups.recording import ReplayingCamera
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.kept_streams import KeptStream, kept_stream
from sms_jobs.instruments.protocols import CameraFacts
from sms_jobs.instruments.streaming import StreamOrder, stream
from sms_jobs.jobs.archiving.repository import brought_in
from sms_jobs.kinds.recording.stream import KIND, StreamParameters, states_of
from sms_jobs.records.streams import StreamSize

SIDE = 1024
CAMERAS = ("C1", "C2")
_DIFFERENT = 4
"""Frames that a camera hands out in turn."""
_PROBE_BYTES = 1 << 28


@dataclass(frozen=True)
class Streaming:
    """What was measured of a stream.

    Attributes
    ----------
    asked_hz, for_s
        What was asked for.
    kept
        What is in the spool.
    whole
        How many moments of it are whole.
    took_s, cpu_s
        From the first exposure until all is synced, and what the process took of the processors.
    """

    asked_hz: float
    for_s: float
    kept: KeptStream
    whole: int
    took_s: float
    cpu_s: float

    @property
    def rate_hz(self) -> float:
        """At which rate moments were kept of which there is a frame of every camera."""
        return self.whole / self.for_s

    @property
    def synced_s(self) -> float:
        """How long after its end all of it was on the disk."""
        return self.took_s - self.for_s

    @property
    def missed(self) -> int:
        """How many frames were late, refused or lost, of both cameras."""
        return round(self.asked_hz * self.for_s) * len(CAMERAS) - self.whole * len(CAMERAS)

    @property
    def refused(self) -> int:
        """How many had no room in memory."""
        return sum(self.kept.account(name).refused for name in CAMERAS)


def streamed(spool: Path, rate_hz: float, for_s: float) -> Streaming:
    """Stream two cameras, which hand out frames made before, into an empty folder."""
    random, clock = np.random.default_rng(5), RealClock()
    facts = CameraFacts(SIDE, SIDE, "uint16", 4095, 0.15, 1.5)
    cameras = {name: ReplayingCamera(speckles(random), clock, facts=facts) for name in CAMERAS}
    rig = ConnectedRig("speed", cameras, {}, clock)
    begun = time.perf_counter(), time.process_time()
    stream(rig, StreamOrder(CAMERAS, StreamSize(rate_hz, for_s)), spool, lambda fraction, words: None)
    took = time.perf_counter() - begun[0], time.process_time() - begun[1]
    kept = kept_stream(spool, CAMERAS)
    assert kept is not None
    return Streaming(rate_hz, for_s, kept, len(kept.whole()), *took)


def speckles(random: np.random.Generator) -> NDArray[np.uint16]:
    """Return 12-bit images of speckles with a camera's noise, (4, rows, columns): none packs like another."""
    pattern = ndimage.gaussian_filter(random.normal(size=(SIDE, SIDE)), 1.5)
    levels = 2000.0 + 900.0 * np.tanh(pattern / pattern.std())
    noisy = levels + random.normal(0.0, 12.0, (_DIFFERENT, SIDE, SIDE))
    return np.asarray(np.clip(noisy, 0, 4095), np.uint16)


def archived_per_cpu_s(kept: KeptStream, folder: Path, states: int) -> float:
    """Return how many images of the first states are judged, sealed and read back in a CPU-second."""
    archive, done = Archive(FolderStore(folder)), 0
    begun = time.process_time()
    for output in states_of(kept, "speed", StreamParameters(number=1), lambda fraction, words: None):
        provenance = brought_in(KIND.name, output.subject, datetime.now(UTC), statistics=output.statistics)
        archive.seal_dataset(output.records, provenance)
        done += 1
        if done == states * len(CAMERAS):
            break
    return done / (time.process_time() - begun)


def disk_mb_s(folder: Path) -> float:
    """Return how fast the disk takes a file of 268 MB that is synced at its end."""
    path, block = folder / "probe", os.urandom(1 << 22)
    begun = time.perf_counter()
    with path.open("wb") as file:
        for _ in range(_PROBE_BYTES // len(block)):
            file.write(block)
        file.flush()
        os.fsync(file.fileno())
    took_s = time.perf_counter() - begun
    path.unlink()
    return 1e-6 * _PROBE_BYTES / took_s
