"""What some cameras record together: a projector's patterns, or one image of each camera without one.

Frames go to the spool as they come, so that a set that breaks off loses nothing of what was complete.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, FrameLost, InstrumentError
from sms_jobs.instruments.bursts import Players, Seen, played
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.judging import Limits, drifted, far_apart, judged, judged_image, wanting
from sms_jobs.instruments.kept_sets import (
    SIMULATION,
    Finished,
    SetWriter,
    frames_of,
    keep,
    keep_dimming,
    new_path,
)
from sms_jobs.instruments.protocols import (
    BurstCamera,
    CameraFacts,
    Fired,
    Frame,
    SequencedProjector,
    apart_s,
)
from sms_jobs.instruments.spool import Spooled, SpoolHeader
from sms_jobs.records.bursts import Burst
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.recording import Verdict
from sms_jobs.records.units import unit_of_name

FRAME_TIMEOUT_S = 5.0
_TRIES = 3
"""How often a pattern, or a burst of them, is projected before a camera that misses it is given up."""

Taken = TypeVar("Taken")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Patterns:
    """What a projector shows.

    Attributes
    ----------
    sequence
        Its patterns, and the exposures that they are recorded with.
    dimming
        (rows, columns) of the projector, what its light is multiplied by; None where nothing is dimmed.
    """

    sequence: FringeSequence
    dimming: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Adaptation:
    """How patterns follow from a quick pre-exposure of a projector's views.

    Attributes
    ----------
    quick
        What is recorded first, and not kept.
    patterns
        Given the projector's name and what each of its cameras has recorded: what is to be recorded. Raises
        `MeasurementFailed` where nothing is lit.
    """

    quick: FringeSequence
    patterns: Callable[[str, Sequence[Measurement]], Patterns]


@dataclass
class RecordedSet(ABC):
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

    def patterned(self) -> dict[str, Any]:
        """Return what the spool keeps of what is projected: nothing where nothing is."""
        return {}

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
        about |= self.patterned()
        frames = frames_of(view, self.sequence)
        header = SpoolHeader(begun, facts.rows, facts.columns, facts.dtype, frames, about)
        return SetWriter(new_path(self.spool, view), header, self.rig.clock)

    def _take(
        self, show: Callable[[], None], writers: Mapping[str, SetWriter], zero: float, looked_at: bool
    ) -> None:
        """Show a pattern and keep what every camera sees of it."""
        self._keep(self._seen(show), writers, zero, looked_at)

    def _keep(self, seen: Seen, writers: Mapping[str, SetWriter], zero: float, looked_at: bool) -> None:
        for camera, frame in seen.items():
            writers[camera].append(frame.number, frame.time_s - zero, frame.image, looked_at)

    def _seen(self, show: Callable[[], None]) -> Seen:
        """Show a pattern and return what every camera sees of it; show it again when one misses it."""

        def take() -> Seen:
            show()
            return self._frames()

        return self._repeated(take, 1, "check the camera's link")

    def _repeated(self, take: Callable[[], Taken], patterns: int, advice: str) -> Taken:
        """Take what is to be seen of some patterns, and all of it again when a camera misses some."""
        for _ in range(1, _TRIES):
            try:
                return take()
            except FrameLost as error:
                logger.warning("%s; it is taken again", error)
                self._retaken += patterns
        try:
            return take()
        except FrameLost as error:
            raise InstrumentError(f"{error}, {_TRIES} times one after the other; {advice}") from error

    def _frames(self) -> Seen:
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
class FringeSet(RecordedSet):
    """A projector's patterns, and white, seen by its cameras."""

    projector: str = ""
    dimming: NDArray[np.float32] | None = None

    def adapted(self, how: Adaptation, progress: Callable[[float, str], None]) -> FringeSet:
        """Return the set with the exposures or the dimming that a pre-exposure of its views asks for."""
        quick = replace(self, sequence=how.quick)
        chosen = how.patterns(self.projector, quick.looked_at(progress))
        return replace(self, sequence=chosen.sequence, dimming=chosen.dimming)

    def looked_at(self, progress: Callable[[float, str], None]) -> list[Measurement]:
        """Record the sequence once, into memory, and return what each camera saw."""
        rig, sequence = self.rig, self.sequence
        begun, facts = rig.clock.now(), [rig.cameras[camera].facts for camera in self.cameras]
        frames = [np.empty((sequence.frames, one.rows, one.columns), one.dtype) for one in facts]
        self.prepare()
        done = 0

        def told(number: int) -> None:
            progress(0.0, f"pre-exposing {self.projector}: frame {number} of {sequence.frames}")

        for exposure in sequence.exposures:
            for seen in self._patterns(exposure, done, told):
                for stack, frame in zip(frames, seen.values(), strict=True):
                    stack[done] = frame.image
                done += 1
        rig.projectors[self.projector].dark()
        return [
            Measurement(
                begun,
                sequence,
                one.full_scale,
                one.gain,
                one.read_noise,
                stack[-1].astype(np.uint16),
                ArrayStack(stack),
            )
            for one, stack in zip(facts, frames, strict=True)
        ]

    def patterned(self) -> dict[str, Any]:
        """Return the exposures, and the name of the file that says where the projector was dimmed."""
        dimmed = None if self.dimming is None else keep_dimming(self.spool, self.projector, self.dimming)
        return {"exposures": self.sequence.exposures, "dimming": dimmed}

    def view(self, camera: str) -> str:
        """Return a view such as C1P1."""
        return camera + self.projector

    def prepare(self) -> None:
        """Have the projector ready."""
        self.rig.video.feed(self.projector)
        self.rig.projectors[self.projector].load(self.sequence, self.dimming)

    def take_all(
        self, writers: Mapping[str, SetWriter], zero: float, progress: Callable[[float, str], None]
    ) -> None:
        """Take exposure by exposure, pattern by pattern, white at last."""
        projector, sequence = self.rig.projectors[self.projector], self.sequence
        done, total = 0, sequence.frames + 1

        def told(number: int) -> None:
            progress(number / total, f"recording {self.projector}: frame {number} of {total}")

        for exposure in sequence.exposures:
            looked_at = exposure == min(sequence.exposures)  # the others may saturate
            for seen in self._patterns(exposure, done, told):
                self._keep(seen, writers, zero, looked_at)
                done += 1
        self._arm(self.texture_exposure)
        self._take(projector.white, writers, zero, looked_at=False)
        projector.dark()

    def burst(self, exposure: float) -> Burst | None:
        """Return how the patterns of an exposure are played; None where they are shown one by one."""
        patterns = self.sequence.frames_per_exposure
        return self.rig.burst(self.projector, self.cameras, patterns, exposure)

    def _patterns(self, exposure: float, done: int, told: Callable[[int], None]) -> Iterator[Seen]:
        """Yield what every camera sees of each pattern, in order: shown one by one, or played in a burst.

        Of a burst nothing is yielded until all of it is there and fits together. `told` is given the number
        of each frame, of which `done` were before, when it is kept or has come in.
        """
        burst, projector = self.burst(exposure), self.rig.projectors[self.projector]
        if burst is not None:
            yield from self._played(burst, lambda number: told(done + number))
            return
        self._arm(exposure)
        for pattern in range(self.sequence.frames_per_exposure):
            yield self._seen(partial(projector.show, pattern))
            told(done + pattern + 1)

    def _played(self, burst: Burst, told: Callable[[int], None]) -> Iterator[Seen]:
        """Yield what every camera saw of a burst that is whole."""
        projector, cameras = self.rig.projectors[self.projector], dict[str, BurstCamera]()
        assert isinstance(projector, SequencedProjector)  # a rig file gives pulses to no other
        for name in self.cameras:
            camera = self.rig.cameras[name]
            assert isinstance(camera, BurstCamera)
            cameras[name] = camera
        take = partial(played, Players(projector, cameras), burst, FRAME_TIMEOUT_S, told)
        found = self._repeated(
            take, burst.frames, "check the wires of the pulses, and period_ms and readout_ms"
        )
        self._next_number = {name: frame.number + 1 for name, frame in found[-1].items()}
        for seen in found:
            for name, frame in seen.items():
                require_size(name, frame, cameras[name].facts)
        while found:  # what is written need not be kept in memory
            yield found.pop(0)

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
class LampSet(RecordedSet):
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
