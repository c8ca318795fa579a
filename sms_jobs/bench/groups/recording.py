"""Recording: how many frames of two cameras go to the spool in a second, for how long."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import recorded
from sms_jobs.instruments.protocols import CameraFacts, Frame
from sms_jobs.instruments.recorder import record_state
from sms_jobs.records.measurement import FringeSequence

SIDE = 2048
_KEPT = 4
"""Different frames that a camera hands out in turn."""
_SEQUENCE = FringeSequence(tuple(range(1, 61)), 15)
"""1800 patterns: a minute of two cameras at 60 frames a second in all."""
_QUICK = FringeSequence((1, 2), 3)


@dataclass
class ReplayingCamera:
    """Delivers frames that were made before, as fast as it is asked: only keeping them takes time."""

    frames: NDArray[np.uint16]
    clock: RealClock
    _number: int = 0
    facts: CameraFacts = field(default_factory=lambda: CameraFacts(SIDE, SIDE, "uint16", 4095, 0.15, 1.5))

    def arm(self, exposure: float) -> None:
        """Do nothing: it is ready."""

    def trigger(self) -> None:
        """Do nothing: the frame is there."""

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame."""
        self._number += 1
        return Frame(self._number, self.clock.monotonic(), self.frames[self._number % len(self.frames)])

    def disarm(self) -> None:
        """Do nothing."""


class InstantProjector:
    """Shows every pattern at once."""

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        """Do nothing."""

    def show(self, number: int) -> None:
        """Do nothing."""

    def white(self) -> None:
        """Do nothing."""

    def dark(self) -> None:
        """Do nothing."""


def _frames(random: np.random.Generator) -> NDArray[Any]:
    """Return 12-bit phase steps of fringes with a camera's noise."""
    x = np.arange(SIDE)
    made = np.empty((_KEPT, SIDE, SIDE), np.uint16)
    for k in range(_KEPT):
        fringes = 1500.0 + 1200.0 * np.cos(2.0 * np.pi * (32.0 * x / SIDE + k / _KEPT))
        made[k] = np.clip(fringes + random.normal(0.0, 12.0, (SIDE, SIDE)), 0, 4095)
    return made


def measure(run: Run) -> Iterator[Found]:
    """Yield the rate and its conditions."""
    run.say("recording: two cameras of 4 megapixels into the spool")
    random, clock = np.random.default_rng(7), RealClock()
    sequence = _QUICK if run.quick else _SEQUENCE
    cameras = {name: ReplayingCamera(_frames(random), clock) for name in ("C1", "C2")}
    rig = ConnectedRig("speed", cameras, {"P1": InstantProjector()}, clock)
    begun = time.perf_counter(), time.process_time()
    record_state(rig, ("C1P1", "C2P1"), sequence, run.folder / "spool", Limits(0.02, 0.0, 1), _nobody)
    wall, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
    count = 2 * (sequence.frames + 1)
    times = recorded(run.folder / "spool", "C1P1", sequence)[1].times_s
    seconds = np.histogram(times, np.arange(0.0, times[-1] + 1e-9, 1.0))[0] if times[-1] > 2.0 else times[:0]
    yield Figure("frames_4mpx_per_s", count / wall, "frames / s", 60.0)
    yield Figure("frames_4mpx_per_cpu_s", count / cpu, "frames / CPU-s")
    yield Figure("slowest_second_frames", 2.0 * seconds.min() if len(seconds) else None, "frames")
    yield Condition(
        "frames",
        f"{count} frames of {SIDE} x {SIDE} px in uint16, {count * 2e-9 * SIDE**2:.1f} GB in {wall:.1f} s, "
        "from two cameras that hand out frames made before, through the recorder with numbers, checksums, a "
        "look at every frame for saturation and a sync every second, to the disk of the temporary folder; "
        "compressing and sealing come later and are not in it; the slowest second is of both cameras",
    )


def _nobody(fraction: float, words: str) -> None:
    """Listen to progress."""


GROUP = Group("recording", "keeping the frames of two cameras of 4 Mpx", lambda: None, measure)
