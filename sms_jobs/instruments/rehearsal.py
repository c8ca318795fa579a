"""How long a recording takes and how much it makes, before it is made.

Nothing is computed beside the recorder: it runs, with simulators in place of all that hangs on wires, with
cameras that only take their time, and on a clock that nobody waits for.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InstrumentError
from sms_jobs.instruments.clock import Clock, SimulatedClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import frames_of
from sms_jobs.instruments.protocols import Camera, CameraFacts, Fired, Frame
from sms_jobs.instruments.recorder import by_projector, record_state
from sms_jobs.instruments.recording_sets import Adaptation
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.bursts import Burst
from sms_jobs.records.instruments import Instruments, SerialChannel, Stage, TriggerController, VideoSplitter
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import RigFile, VirtualCamera, VirtualProjector
from sms_jobs.records.serial_links import SIMULATED
from sms_jobs.records.shown.rehearsals import StateRehearsal
from sms_jobs.records.views import view_of

Wired = TypeVar("Wired", Stage, TriggerController, VideoSplitter, SerialChannel)

BYTES_A_PIXEL = 2
"""Of cameras with more than 8 bits, as which all are counted."""


def rehearse(
    rig: RigFile,
    views: Sequence[str],
    sequence: FringeSequence,
    poses: Sequence[StagePose | None],
    texture_exposure: float = 1.0,
    adaptation: Adaptation | None = None,
) -> tuple[StateRehearsal, ...]:
    """Return what recording a state at each of some poses takes, in order.

    What is computed is not counted: neither patterns, nor the light of a virtual rig, nor the archive's
    work, which comes after the specimen is free. Transfers from cameras are taken to go on beside exposures.

    Parameters
    ----------
    views
        All of whose sensors the rig has.
    poses
        Of the stage; None where nothing moves.
    texture_exposure, adaptation
        See `record_state`; what is adapted at the rig is not known here, and counted as it is returned.

    Raises
    ------
    InvalidInput
        When the rig does not have a sensor of a view.
    """
    silent = _simulated(rig)
    recording_s = _sets(rig, silent, views, sequence, texture_exposure, adaptation)
    frames = sum(frames_of(view, sequence) for view in views)
    sizes = {c.name: c.rows * c.columns for c in rig.cameras}
    sets: Counter[str] = Counter()
    for name in views:
        view = view_of(name)
        # Cameras without a projector are one set.
        sets["".join(view.projectors)] += frames_of(name, sequence) * sizes[view.camera] * BYTES_A_PIXEL
    return tuple(
        StateRehearsal(moving_s, recording_s, frames, sets.total(), max(sets.values()), problem)
        for moving_s, problem in _moves(rig, silent, poses)
    )


def _sets(
    rig: RigFile,
    silent: RigFile,
    views: Sequence[str],
    sequence: FringeSequence,
    texture_exposure: float,
    adaptation: Adaptation | None,
) -> float:
    """Return how long all sets of a state take."""
    clock = SimulatedClock()
    with TemporaryDirectory() as folder, connected(silent, clock=clock) as found:
        timed = replace(
            found,
            cameras={c.name: _TimedCamera(clock, c.exposure_s) for c in rig.cameras},
            projectors={p.name: _TimedProjector(clock, p.settle_s, p.load_s) for p in rig.projectors},
            trigger=_TimedTrigger(found),
            burst=rig.burst,
        )
        begun = clock.monotonic()
        spool = Path(folder) / "spool"
        record_state(
            timed,
            views,
            sequence,
            spool,
            Limits(lit_fraction=0.0, recordings=1),
            _nobody,
            texture_exposure,
            adaptation,
        )
        return clock.monotonic() - begun


def ways(rig: RigFile, views: Sequence[str], sequence: FringeSequence) -> dict[str, str]:
    """Return for each projector of some views how its patterns come before their cameras, in words."""
    return {
        name: f"{sequence.frames_per_exposure} {rig.way(name, cameras, sequence.exposures)}"
        for name, cameras in by_projector(views).items()
    }


def _moves(rig: RigFile, silent: RigFile, poses: Sequence[StagePose | None]) -> list[tuple[float, str]]:
    """Return for each pose how long connecting and moving takes, and what keeps the stage from it."""
    # A stage on a wire knows its home from one recording to the next; a simulated one begins anew.
    forgets = rig.stage is not None and rig.stage.link.port == SIMULATED
    clock = SimulatedClock()
    moves = []
    with ExitStack() as standing:
        found: ConnectedRig | None = None
        connecting_s = 0.0
        for pose in poses:
            begun = clock.monotonic()
            if found is None or forgets:
                standing.close()
                found = standing.enter_context(connected(silent, clock=clock))
                connecting_s = clock.monotonic() - begun
                begun = clock.monotonic()
            problem = "" if pose is None else _go(found, pose)
            moves.append((connecting_s + clock.monotonic() - begun, problem))
    return moves


def _go(rig: ConnectedRig, pose: StagePose) -> str:
    """Bring the stage into a pose, and return why it cannot be there."""
    if rig.stage is None:
        return f"rig {rig.name} has no stage: describe one under [[stages]] of its file"
    try:
        rig.stage.stage()
        rig.stage.set(pose).wait()
    except InstrumentError as error:
        return str(error)
    return ""


def _simulated(rig: RigFile) -> RigFile:
    """Return a rig all of whose wires lead to simulators, without faults; files are read in no time."""
    serial = rig.serial
    return RigFile(
        rig.name,
        tuple(VirtualCamera(c.name, c.columns, c.rows, "simulated") for c in rig.cameras),
        tuple(VirtualProjector(p.name, p.columns, p.rows, "simulated") for p in rig.projectors),
        Instruments(
            tuple(map(_on_no_port, serial.stages)),
            tuple(map(_on_no_port, serial.triggers)),
            tuple(map(_on_no_port, serial.splitters)),
            tuple(_on_no_port(c) for c in serial.channels if isinstance(c, SerialChannel)),
        ),
    )


def _on_no_port(instrument: Wired) -> Wired:
    return replace(instrument, link=replace(instrument.link, port=SIMULATED), faults=())


def _nobody(fraction: float, words: str) -> None:
    """Receive the progress of a rehearsal."""


@dataclass
class _TimedCamera:
    """A camera that takes as long as its exposure, and sees nothing."""

    clock: Clock
    exposure_s: float
    _exposure: float = 1.0
    _until: float = 0.0
    _number: int = 0
    _period_s: float = 0.0
    facts: CameraFacts = field(default=CameraFacts(1, 1, "uint16", 1, 1.0, 0.0))

    def arm(self, exposure: float) -> None:
        self._exposure = exposure
        self._period_s = 0.0

    def arm_burst(self, burst: Burst) -> None:
        self._period_s = burst.period_s
        self._until = self.clock.monotonic() + burst.lead_s + burst.exposure * self.exposure_s

    def left_over(self, timeout_s: float) -> int:
        self.clock.sleep(timeout_s)
        return 0

    def trigger(self) -> None:
        self._until = self.clock.monotonic() + self._exposure * self.exposure_s

    def read(self, timeout_s: float) -> Frame:
        self.clock.sleep(self._until - self.clock.monotonic())
        self._number += 1
        exposed_s, self._until = self._until, self._until + self._period_s
        return Frame(self._number, exposed_s, np.zeros((1, 1), np.uint16))

    def disarm(self) -> None:
        pass


@dataclass
class _TimedTrigger:
    """Exposes cameras when the real trigger would have, by whichever wire."""

    wired: ConnectedRig

    def fire(self, cameras: Mapping[str, Camera]) -> Mapping[str, Fired]:
        fired = self.wired.fire(cameras)
        for camera in cameras.values():
            camera.trigger()
        return fired


@dataclass
class _TimedProjector:
    """A projector that takes its time, and shows nothing."""

    clock: Clock
    settle_s: float
    load_s: float
    _loaded: FringeSequence | None = None
    _until: float = 0.0

    def load(self, sequence: FringeSequence, dimming: NDArray[np.float32] | None = None) -> None:
        wanted = replace(sequence, exposures=(1.0,))
        if wanted != self._loaded:
            self.clock.sleep(self.load_s)
        self._loaded = wanted

    def show(self, number: int) -> None:
        self.clock.sleep(self.settle_s)

    def white(self) -> None:
        self.clock.sleep(self.settle_s)

    def play(self, burst: Burst) -> None:
        self._until = self.clock.monotonic() + burst.seconds

    def wait(self) -> None:
        self.clock.sleep(self._until - self.clock.monotonic())

    def dark(self) -> None:
        pass
