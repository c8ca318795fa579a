"""Projectors in turn, all of their cameras at once: how a state is recorded with instruments.

Frames go to the spool as they come, so that a set that breaks off loses nothing of what was complete. What
is wrong with a set is found while the specimen is still held: a frame that a camera did not deliver is
taken again at once, and a set that is saturated or dark as often as the order allows.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from sms_jobs.errors import FrameLost, InstrumentError, InvalidInput, StorageFull
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.judging import LOOKED_AT, Limits, drifted, judged, wanting
from sms_jobs.instruments.protocols import (
    Camera,
    Channel,
    DirectVideo,
    Frame,
    Projector,
    SoftwareTrigger,
    Stage,
    Trigger,
    Video,
)
from sms_jobs.instruments.spool import Spooled, SpooledFrames, SpoolHeader, SpoolWriter
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.recording import InterruptedRecording, Recording, Verdict
from sms_jobs.records.scene import Simulation
from sms_jobs.records.views import view_of

FRAME_TIMEOUT_S = 5.0
_TRIES = 3
"""How often a pattern is projected before a camera that misses it is given up."""
_SYNC_EVERY_S = 1.0
_WAITING_FRAMES = 4
"""Of each camera that may wait for the disk."""
_SIMULATION = TypeAdapter(Simulation)
_FRAMES = ".frames"
_INTERRUPTED = ".interrupted"

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConnectedRig:
    """The instruments of a rig, connected.

    Attributes
    ----------
    name
        Of the rig.
    cameras, projectors
        By name: C1, ..., P1, ...
    clock
        Of the rig.
    trigger
        What makes the cameras expose.
    channels
        Scalar readings, by name.
    stage
        That carries a calibration artefact; None where there is none.
    video
        What brings the picture to a projector.
    simulation
        What a view truly sees now; None for real instruments.
    described
        What each sensor said of itself when it was connected, by name.
    """

    name: str
    cameras: Mapping[str, Camera]
    projectors: Mapping[str, Projector]
    clock: Clock
    trigger: Trigger = field(default_factory=SoftwareTrigger)
    channels: Mapping[str, Channel] = field(default_factory=dict)
    stage: Stage | None = None
    video: Video = field(default_factory=DirectVideo)
    simulation: Callable[[str], Simulation] | None = None
    described: Mapping[str, str] = field(default_factory=dict)

    def read_channels(self) -> dict[str, float]:
        """Return what every channel reads now."""
        return {name: channel.read() for name, channel in self.channels.items()}


def record_state(
    rig: ConnectedRig,
    views: Sequence[str],
    sequence: FringeSequence,
    spool: Path,
    limits: Limits,
    progress: Callable[[float, str], None],
    texture_exposure: float = 1.0,
) -> None:
    """Record every view of a state into the spool; views that are there already are left alone.

    Parameters
    ----------
    views
        Such as C1P1, in order of their projectors.
    spool
        Folder of the job; it holds one file a view afterwards, see `finished` and `recorded`.
    progress
        Told a fraction and a few words; may raise to stop the recording, which leaves the projectors dark.
    texture_exposure
        Of the white frame, in units of the camera's own.

    Raises
    ------
    InvalidInput
        When the rig does not have a sensor of a view, or a channel that has to be read.
    InstrumentError
        When an instrument gives up; complete frames stay in the spool.
    StorageFull
        When the spool's disk has no room for these sets, or is full on the way.
    """
    limits.require_channels(rig.name, rig.channels)
    spool.mkdir(parents=True, exist_ok=True)
    _set_aside_interrupted(spool)
    by_projector = _by_projector(rig, [p for p in views if not is_finished(spool, p)])
    _require_room(rig, by_projector, sequence.frames + 1, spool)
    with ExitStack() as stack:
        for projector in rig.projectors.values():
            stack.callback(_quietly, projector.dark)
        for camera in rig.cameras.values():
            stack.callback(_quietly, camera.disarm)
        for number, (name, cameras) in enumerate(by_projector.items()):

            def part(fraction: float, words: str, number: int = number) -> None:
                progress((number + fraction) / len(by_projector), words)

            for attempt in range(1, limits.recordings + 1):
                taken = _Set(rig, name, cameras, sequence, texture_exposure, spool, attempt)
                doubts = taken.record(limits, part)
                for words in doubts:
                    logger.warning("%s", words)
                if not doubts:
                    break


def is_finished(spool: Path, view: str) -> bool:
    """Say whether a whole set of a view is in the spool."""
    return _facts_path(spool, view).is_file()


def recorded(spool: Path, view: str, sequence: FringeSequence) -> tuple[Measurement, Recording]:
    """Return a finished set; its frames are read from the spool as they are asked for."""
    facts = json.loads(_facts_path(spool, view).read_text(encoding="utf-8"))
    file = Spooled(spool / facts["file"])
    about = file.header.about
    numbers, times = file.numbers_and_times(file.complete)
    measurement = Measurement(
        file.header.recorded_at,
        sequence,
        about["full_scale"],
        about["gain"],
        about["read_noise"],
        file.frame(sequence.frames).astype(np.uint16),
        SpooledFrames(file, sequence.frames),
        None if about["simulation"] is None else _SIMULATION.validate_python(about["simulation"]),
    )
    return measurement, Recording(
        about["rig"],
        Verdict(**{**facts["verdict"], "doubts": tuple(facts["verdict"]["doubts"])}),
        facts["retaken"],
        facts["recordings"],
        about["channels"],
        facts["channels"],
        None if about["stage_rad"] is None else tuple(about["stage_rad"]),
        numbers=numbers,
        times_s=times,
    )


def interrupted(spool: Path, view: str, sequence: FringeSequence) -> list[InterruptedRecording]:
    """Return the sets of a view that broke off after one complete frame or more, in order."""
    found = []
    for path in _files(spool, view):
        file = Spooled(path)
        count = min(file.complete, sequence.frames)
        if path.suffix == _INTERRUPTED and count:
            numbers, times = file.numbers_and_times(count)
            full_scale = file.header.about["full_scale"]
            frames = SpooledFrames(file, count)
            found.append(
                InterruptedRecording(file.header.recorded_at, sequence, full_scale, numbers, times, frames)
            )
    return found


@dataclass
class _Set:
    """One set: a projector's patterns, seen by its cameras."""

    rig: ConnectedRig
    projector: str
    cameras: tuple[str, ...]
    sequence: FringeSequence
    texture_exposure: float
    spool: Path
    attempt: int
    _retaken: int = 0
    _next_number: dict[str, int] = field(default_factory=dict)

    def record(self, limits: Limits, progress: Callable[[float, str], None]) -> tuple[str, ...]:
        """Record the set and return what is wrong with it, in words."""
        rig, sequence = self.rig, self.sequence
        begun, channels = rig.clock.now(), rig.read_channels()
        zero = rig.clock.monotonic()
        projector = rig.projectors[self.projector]
        rig.video.feed(self.projector)
        projector.load(sequence)
        with ExitStack() as stack:
            writers = {
                camera: stack.enter_context(self._writer(camera, begun, channels)) for camera in self.cameras
            }
            done, total = 0, sequence.frames + 1
            for exposure in sequence.exposures:
                self._arm(exposure)
                looked_at = exposure == min(sequence.exposures)  # the others may saturate
                for pattern in range(sequence.frames_per_exposure):
                    self._take(partial(projector.show, pattern), writers, zero, looked_at)
                    done += 1
                    progress(done / total, f"recording {self.projector}: frame {done} of {total}")
            self._arm(self.texture_exposure)
            self._take(projector.white, writers, zero, looked_at=False)
            projector.dark()
        after = rig.read_channels()
        units = {name: channel.unit for name, channel in rig.channels.items()}
        moved = drifted(channels, after, units, limits)
        doubts: list[str] = []
        for camera in self.cameras:
            doubts += self._finish(camera, writers[camera].saturated, after, limits, moved)
        return tuple(doubts)

    def _arm(self, exposure: float) -> None:
        for camera in self.cameras:
            self.rig.cameras[camera].arm(exposure)

    def _writer(self, camera: str, begun: datetime, channels: dict[str, float]) -> _Writer:
        facts, stage = self.rig.cameras[camera].facts, self.rig.stage
        about = {
            "rig": self.rig.name,
            "full_scale": facts.full_scale,
            "gain": facts.gain,
            "read_noise": facts.read_noise,
            "channels": channels,
            "stage_rad": None if stage is None else stage.known_angles(),
            "simulation": None,
        }
        if self.rig.simulation is not None:
            truth = self.rig.simulation(camera + self.projector)
            about["simulation"] = _SIMULATION.dump_python(truth, mode="json")
        header = SpoolHeader(begun, facts.rows, facts.columns, facts.dtype, self.sequence.frames + 1, about)
        return _Writer(_new_path(self.spool, camera + self.projector), header, self.rig.clock)

    def _take(
        self, show: Callable[[], None], writers: Mapping[str, _Writer], zero: float, looked_at: bool
    ) -> None:
        """Show a pattern and keep what every camera sees of it; show it again when one misses it."""
        for tries in range(1, _TRIES + 1):
            show()
            try:
                frames = self._frames()
                break
            except FrameLost as error:
                if tries == _TRIES:
                    raise InstrumentError(
                        f"{error}, {_TRIES} times one after the other; check the camera's link"
                    ) from error
                logger.warning("%s; the pattern is shown again", error)
                self._retaken += 1
        for camera, frame in frames.items():
            writers[camera].append(frame.number, frame.time_s - zero, frame.image, looked_at)

    def _frames(self) -> dict[str, Frame]:
        """Trigger all cameras and return what they deliver; raise `FrameLost` when one delivers nothing."""
        cameras = {name: self.rig.cameras[name] for name in self.cameras}
        self.rig.trigger.fire(cameras)
        frames, lost = {}, None
        for name, camera in cameras.items():  # all are read, so that none is a frame behind afterwards
            try:
                frames[name] = camera.read(FRAME_TIMEOUT_S)
            except FrameLost as error:
                lost = error
                self._next_number.pop(name, None)  # the camera may have counted the lost frame, or not
                continue
            expected = self._next_number.get(name, frames[name].number)
            self._next_number[name] = frames[name].number + 1
            if frames[name].number != expected:
                lost = FrameLost(f"camera {name} went from frame {expected - 1} to {frames[name].number}")
        if lost is not None:
            raise lost
        return frames

    def _finish(
        self,
        camera: str,
        saturated: NDArray[np.bool_],
        channels: dict[str, float],
        limits: Limits,
        moved: list[str],
    ) -> list[str]:
        """Judge a camera's set and mark it as finished; return what is wrong with it."""
        view = camera + self.projector
        path = _newest(self.spool, view)
        verdict = judged(Spooled(path), self.sequence, saturated)
        doubts = [f"{view}: {words}" for words in (*wanting(verdict, limits), *moved)]
        facts = {
            "file": path.name,
            "verdict": vars(replace(verdict, doubts=tuple(doubts))),
            "retaken": self._retaken,
            "recordings": self.attempt,
            "channels": channels,
        }
        marker = _facts_path(self.spool, view)
        beside = marker.with_suffix(".new")
        beside.write_text(json.dumps(facts), encoding="utf-8")
        before = json.loads(marker.read_text(encoding="utf-8"))["file"] if marker.is_file() else None
        beside.replace(marker)
        if before is not None:
            (self.spool / before).unlink()
        return doubts


class _Writer:
    """Writes frames from a thread of its own, so that the next pattern need not wait for the disk."""

    def __init__(self, path: Path, header: SpoolHeader, clock: Clock) -> None:
        self._file = SpoolWriter(path, header)
        self._clock = clock
        self._synced = clock.monotonic()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="spool")
        self._pending: deque[Future[None]] = deque()
        self._full_scale = header.about["full_scale"]
        self.saturated = np.zeros((header.rows, header.columns), np.bool_)[LOOKED_AT]

    def append(self, number: int, time_s: float, image: NDArray[Any], looked_at: bool) -> None:
        """Have a frame written and looked at; raise `StorageFull` when one before could not be."""
        while len(self._pending) >= _WAITING_FRAMES:
            self._pending.popleft().result()
        if looked_at:
            self.saturated |= image[LOOKED_AT] >= self._full_scale
        self._pending.append(self._thread.submit(self._file.append, number, time_s, image))
        if self._clock.monotonic() > self._synced + _SYNC_EVERY_S:
            self._synced = self._clock.monotonic()
            self._pending.append(self._thread.submit(self._file.sync))

    def __enter__(self) -> _Writer:
        return self

    def __exit__(self, *problem: object) -> None:
        try:
            while self._pending:
                self._pending.popleft().result()
        finally:
            self._thread.shutdown()
            self._file.close()


def _by_projector(rig: ConnectedRig, views: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the cameras of each projector, both in the order of the views."""
    found: dict[str, tuple[str, ...]] = {}
    for view in map(view_of, views):
        camera, projector = view.camera, view.projector
        for name, known in ((camera, rig.cameras), (projector, rig.projectors)):
            if name not in known:
                raise InvalidInput(
                    f"rig {rig.name} has no {name} for the view {view}; it has "
                    f"{', '.join([*rig.cameras, *rig.projectors])}"
                )
        found[projector] = (*found.get(projector, ()), camera)
    return found


def _require_room(
    rig: ConnectedRig, by_projector: Mapping[str, tuple[str, ...]], frames: int, spool: Path
) -> None:
    """Raise `StorageFull` when sets of so many frames have no room, before a load is held for them."""
    facts = [rig.cameras[camera].facts for cameras in by_projector.values() for camera in cameras]
    needed = sum(frames * f.rows * f.columns * np.dtype(f.dtype).itemsize for f in facts)
    free = shutil.disk_usage(spool).free
    if needed > free:
        raise StorageFull(
            f"the disk of the spool, {spool}, has {free / 1e6:.0f} MB left, and the frames of this state "
            f"need {needed / 1e6:.0f} MB; free some space"
        )


def _set_aside_interrupted(spool: Path) -> None:
    """Mark the files of sets that broke off, so that nobody takes them for more than they are."""
    kept = {json.loads(p.read_text(encoding="utf-8"))["file"] for p in spool.glob("*.json")}
    for path in spool.glob(f"*{_FRAMES}"):
        if path.name not in kept:
            path.rename(path.with_suffix(_INTERRUPTED))


def _facts_path(spool: Path, view: str) -> Path:
    return spool / f"{view}.json"


def _files(spool: Path, view: str) -> list[Path]:
    return sorted(spool.glob(f"{view}.[0-9]*"))


def _new_path(spool: Path, view: str) -> Path:
    return spool / f"{view}.{len(_files(spool, view)) + 1:03d}{_FRAMES}"


def _newest(spool: Path, view: str) -> Path:
    return _files(spool, view)[-1]


def _quietly(what: Callable[[], None]) -> None:
    """Do what is to be done at the end; a lost link must not hide why the recording ended."""
    with suppress(InstrumentError):
        what()
