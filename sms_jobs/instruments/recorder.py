"""Projectors in turn, all of their cameras at once, then the cameras without one: how a state is recorded.

Frames go to the spool as they come, so that a set that breaks off loses nothing of what was complete. What
is wrong with a set is found while the specimen is still held: a frame that a camera did not deliver is
taken again at once, and a set that is saturated or dark as often as the order allows.
"""

from __future__ import annotations

import logging
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from sms_jobs.errors import DeviceFault, FrameLost, InstrumentError, InvalidInput, StorageFull
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.judging import Limits, drifted, far_apart, judged, judged_image, wanting
from sms_jobs.instruments.kept_sets import (
    SIMULATION,
    Finished,
    SetWriter,
    frames_of,
    keep,
    kept,
    new_path,
    set_aside_interrupted,
)
from sms_jobs.instruments.protocols import (
    Camera,
    CameraFacts,
    Channel,
    DirectVideo,
    Fired,
    Frame,
    Lamp,
    Projector,
    SoftwareTrigger,
    Stage,
    StandingLamp,
    Trigger,
    Video,
    apart_s,
    recorded_value,
)
from sms_jobs.instruments.spool import Spooled, SpoolHeader
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.recording import Verdict
from sms_jobs.records.scene import Simulation
from sms_jobs.records.units import unit_of_name
from sms_jobs.records.views import view_of

FRAME_TIMEOUT_S = 5.0
_TRIES = 3
"""How often a pattern is projected before a camera that misses it is given up."""

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
        What makes the cameras expose; None for a trigger over the link of each.
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
    lamp
        What lights a specimen that is recorded without a projector.
    """

    name: str
    cameras: Mapping[str, Camera]
    projectors: Mapping[str, Projector]
    clock: Clock
    trigger: Trigger | None = None
    channels: Mapping[str, Channel] = field(default_factory=dict)
    stage: Stage | None = None
    video: Video = field(default_factory=DirectVideo)
    simulation: Callable[[str], Simulation] | None = None
    described: Mapping[str, str] = field(default_factory=dict)
    lamp: Lamp = field(default_factory=StandingLamp)

    def fire(self, cameras: Mapping[str, Camera]) -> Mapping[str, Fired]:
        """Expose some cameras together, and return by name when that was."""
        return (self.trigger or SoftwareTrigger(self.clock)).fire(cameras)

    def read_channels(self) -> dict[str, float]:
        """Return what every channel reads now, as it is recorded: in the unit of its name."""
        return {name: recorded_value(name, one, one.read()) for name, one in self.channels.items()}


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
        Such as C1P1, in order of their projectors; cameras without one, such as C1, are recorded last, all
        of them at once, and all of them again where one of them is not there.
    spool
        Folder of the job; it holds one file a view afterwards, see `kept_sets`.
    progress
        Told a fraction and a few words; may raise to stop the recording, which leaves the projectors dark.
    texture_exposure
        Of the white frame, and of images without a projector, in units of the camera's own.

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
    set_aside_interrupted(spool)
    there = kept(spool)
    missing = [view for view in views if view not in there]
    _require_sensors(rig, missing)
    _require_room(rig, missing, sequence, spool)
    lamplit = [view for view in views if not view_of(view).projectors]
    # Images that are to show one state are recorded at one time, whichever of them was lost.
    sets: list[_Set] = [
        _FringeSet(rig, cameras, sequence, texture_exposure, spool, limits, projector=projector)
        for projector, cameras in _by_projector(missing).items()
    ]
    if any(view in missing for view in lamplit):
        sets.append(_LampSet(rig, tuple(lamplit), sequence, texture_exposure, spool, limits))
    with ExitStack() as stack:
        stack.callback(quietly, rig.lamp.off)
        for projector in rig.projectors.values():
            stack.callback(quietly, projector.dark)
        for camera in rig.cameras.values():
            stack.callback(quietly, camera.disarm)
        for number, one in enumerate(sets):

            def part(fraction: float, words: str, number: int = number) -> None:
                progress((number + fraction) / len(sets), words)

            _until_good(one, part)


def _until_good(one: _Set, progress: Callable[[float, str], None]) -> None:
    """Record a set until nothing is wrong with it, as often as it may be."""
    for attempt in range(1, one.limits.recordings + 1):
        doubts = replace(one, attempt=attempt).record(progress)
        for words in doubts:
            logger.warning("%s", words)
        if not doubts:
            return


@dataclass
class _Set(ABC):
    """What some cameras record together."""

    rig: ConnectedRig
    cameras: tuple[str, ...]
    sequence: FringeSequence
    texture_exposure: float
    spool: Path
    limits: Limits
    attempt: int = 1
    _retaken: int = field(default=0, init=False)
    _next_number: dict[str, int] = field(default_factory=dict, init=False)
    _fired: tuple[Fired, ...] = field(default=(), init=False)
    """When its last frames were exposed."""

    def record(self, progress: Callable[[float, str], None]) -> tuple[str, ...]:
        """Record the set and return what is wrong with it, in words."""
        rig = self.rig
        begun, channels = rig.clock.now(), rig.read_channels()
        zero = rig.clock.monotonic()
        self.prepare()
        with ExitStack() as stack:
            writers = {
                camera: stack.enter_context(self._writer(camera, begun, channels)) for camera in self.cameras
            }
            self.take_all(writers, zero, progress)
        after = rig.read_channels()
        units = {name: unit_of_name(name, channel.unit) for name, channel in rig.channels.items()}
        moved = drifted(channels, after, units, self.limits)
        return self.finish(writers, after, moved)

    @abstractmethod
    def view(self, camera: str) -> str:
        """Return what a camera records here."""

    @abstractmethod
    def prepare(self) -> None:
        """Have the light ready."""

    @abstractmethod
    def take_all(
        self, writers: Mapping[str, SetWriter], zero: float, progress: Callable[[float, str], None]
    ) -> None:
        """Take every frame; times are those since `zero`."""

    @abstractmethod
    def finish(
        self, writers: Mapping[str, SetWriter], channels: dict[str, float], moved: list[str]
    ) -> tuple[str, ...]:
        """Judge what was taken, mark it as whole, and return what is wrong with it."""

    def _arm(self, exposure: float) -> None:
        for camera in self.cameras:
            self.rig.cameras[camera].arm(exposure)

    def _writer(self, camera: str, begun: datetime, channels: dict[str, float]) -> SetWriter:
        facts, stage, view = self.rig.cameras[camera].facts, self.rig.stage, self.view(camera)
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
            about["simulation"] = SIMULATION.dump_python(self.rig.simulation(view), mode="json")
        frames = frames_of(view, self.sequence)
        header = SpoolHeader(begun, facts.rows, facts.columns, facts.dtype, frames, about)
        return SetWriter(new_path(self.spool, view), header, self.rig.clock)

    def _take(
        self, show: Callable[[], None], writers: Mapping[str, SetWriter], zero: float, looked_at: bool
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
                logger.warning("%s; it is taken again", error)
                self._retaken += 1
        for camera, frame in frames.items():
            writers[camera].append(frame.number, frame.time_s - zero, frame.image, looked_at)

    def _frames(self) -> dict[str, Frame]:
        """Trigger all cameras and return what they deliver; raise `FrameLost` when one delivers nothing."""
        cameras = {name: self.rig.cameras[name] for name in self.cameras}
        fired = self.rig.fire(cameras)
        frames, lost = {}, None
        for name, camera in cameras.items():  # all are read, so that none is a frame behind afterwards
            try:
                frames[name] = camera.read(FRAME_TIMEOUT_S)
            except FrameLost as error:
                lost = error
                self._next_number.pop(name, None)  # the camera may have counted the lost frame, or not
                continue
            require_size(name, frames[name], camera.facts)
            expected = self._next_number.get(name, frames[name].number)
            self._next_number[name] = frames[name].number + 1
            if frames[name].number != expected:
                lost = FrameLost(f"camera {name} went from frame {expected - 1} to {frames[name].number}")
        if lost is not None:
            raise lost
        self._fired = tuple(frame.fired or fired[name] for name, frame in frames.items())
        return frames

    def _finished(
        self,
        view: str,
        writer: SetWriter,
        verdict: Verdict,
        channels: dict[str, float],
        more: Iterable[str],
        apart: float | None = None,
    ) -> Finished:
        """Return what is known of the set of a view; `more` is what speaks against it besides its frames."""
        doubts = tuple(f"{view}: {words}" for words in (*wanting(verdict, self.limits), *more))
        judged_so = replace(verdict, doubts=doubts)
        return Finished(writer.path, judged_so, self._retaken, self.attempt, channels, apart)


@dataclass
class _FringeSet(_Set):
    """A projector's patterns, and white, seen by its cameras."""

    projector: str = ""

    def view(self, camera: str) -> str:
        """Return a view such as C1P1."""
        return camera + self.projector

    def prepare(self) -> None:
        """Have the projector ready."""
        self.rig.video.feed(self.projector)
        self.rig.projectors[self.projector].load(self.sequence)

    def take_all(
        self, writers: Mapping[str, SetWriter], zero: float, progress: Callable[[float, str], None]
    ) -> None:
        """Take exposure by exposure, pattern by pattern, white at last."""
        projector, sequence = self.rig.projectors[self.projector], self.sequence
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

    def finish(
        self, writers: Mapping[str, SetWriter], channels: dict[str, float], moved: list[str]
    ) -> tuple[str, ...]:
        """Judge fringes; each camera's set counts for itself."""
        doubts: list[str] = []
        for camera, writer in writers.items():
            view = self.view(camera)
            verdict = judged(Spooled(writer.path), self.sequence, writer.saturated)
            finished = self._finished(view, writer, verdict, channels, moved)
            keep({view: finished}, together=False)
            doubts += finished.verdict.doubts
        return tuple(doubts)


@dataclass
class _LampSet(_Set):
    """One image of every camera that has no projector: what they see at one moment."""

    def view(self, camera: str) -> str:
        """Return a view such as C1."""
        return camera

    def prepare(self) -> None:
        """Have the lamp on."""
        self.rig.lamp.on()

    def take_all(
        self, writers: Mapping[str, SetWriter], zero: float, progress: Callable[[float, str], None]
    ) -> None:
        """Take the images."""
        self._arm(self.texture_exposure)
        self._take(lambda: None, writers, zero, looked_at=False)
        self.rig.lamp.off()
        progress(1.0, f"recording {', '.join(self.cameras)}: one image each")

    def finish(
        self, writers: Mapping[str, SetWriter], channels: dict[str, float], moved: list[str]
    ) -> tuple[str, ...]:
        """Judge the images, and whether they show one state; they count together."""
        apart = apart_s(self._fired)
        more = [*far_apart(self.cameras, apart, self.limits), *moved]
        found = {
            camera: self._finished(
                camera,
                writer,
                judged_image(Spooled(writer.path), self.limits.speckled),
                channels,
                more,
                apart,
            )
            for camera, writer in writers.items()
        }
        keep(found, together=True)
        return tuple(words for one in found.values() for words in one.verdict.doubts)


def require_size(camera: str, frame: Frame, facts: CameraFacts) -> None:
    """Raise `DeviceFault` for an image that is not as large as its camera said."""
    rows, columns = frame.image.shape
    if (rows, columns) != (facts.rows, facts.columns):
        raise DeviceFault(
            f"camera {camera} delivers an image of {columns} x {rows} px, announced were {facts.columns} x "
            f"{facts.rows}: set it up as the rig file says"
        )


def _require_sensors(rig: ConnectedRig, views: Sequence[str]) -> None:
    """Raise `InvalidInput` for a view that a rig has not the sensors for."""
    known = (*rig.cameras, *rig.projectors)
    for view in map(view_of, views):
        for name in view.sensors:
            if name not in known:
                raise InvalidInput(
                    f"rig {rig.name} has no {name} for the view {view}; it has {', '.join(known)}"
                )


def _by_projector(views: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the cameras of each projector, both in the order of the views."""
    found: dict[str, tuple[str, ...]] = {}
    for view in map(view_of, views):
        for projector in view.projectors:
            found[projector] = (*found.get(projector, ()), view.camera)
    return found


def _require_room(rig: ConnectedRig, views: Sequence[str], sequence: FringeSequence, spool: Path) -> None:
    """Raise `StorageFull` when some views have no room, before a load is held for them."""
    needed = 0
    for view in views:
        facts = rig.cameras[view_of(view).camera].facts
        needed += frames_of(view, sequence) * facts.rows * facts.columns * np.dtype(facts.dtype).itemsize
    free = shutil.disk_usage(spool).free
    if needed > free:
        raise StorageFull(
            f"the disk of the spool, {spool}, has {free / 1e6:.0f} MB left, and the frames of this state "
            f"need {needed / 1e6:.0f} MB; free some space"
        )


def quietly(what: Callable[[], None]) -> None:
    """Do what is to be done at the end; a lost link must not hide why the recording ended."""
    with suppress(InstrumentError):
        what()
