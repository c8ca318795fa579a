"""Frames of cameras at a rate, through memory to the spool, with what channels read meanwhile.

One thread exposes the cameras at its times and reads them, one for each camera writes, one reads the
channels; the thread that calls looks on. Between them lie rings of fixed size, in which frames wait for an
event, if there is one, and then for the disk.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from math import ceil, inf
from pathlib import Path

from sms_jobs.errors import FrameLost, InvalidInput, StorageFull
from sms_jobs.instruments.channel_watch import ChannelWatch
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.frame_memory import image_bytes, require_memory
from sms_jobs.instruments.frame_ring import FrameRing
from sms_jobs.instruments.kept_sets import SIMULATION
from sms_jobs.instruments.kept_streams import (
    READINGS_APART_S,
    LineLog,
    frames_path,
    moments_path,
    readings_path,
)
from sms_jobs.instruments.protocols import Camera, Fired, Frame, apart_s
from sms_jobs.instruments.recorder import quietly
from sms_jobs.instruments.recording_sets import FRAME_TIMEOUT_S, require_size
from sms_jobs.instruments.spool import SpoolHeader, SpoolWriter
from sms_jobs.records.events import Event
from sms_jobs.records.streams import StreamSize

_SYNC_EVERY_S = 1.0
_LOOKS_EVERY_S = 0.05
_LEAST_TIMEOUT_S = 0.25
"""A camera that delivers nothing is waited for so long, or for two frames."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class StreamOrder:
    """What is to be streamed.

    Attributes
    ----------
    cameras
        By name.
    size
        At which rate, for how long, and what of it is kept.
    event
        That frames are kept around; None to keep all.
    exposure
        In units of the cameras' own.
    """

    cameras: tuple[str, ...]
    size: StreamSize
    event: Event | None = None
    exposure: float = 1.0


def stream(
    rig: ConnectedRig, order: StreamOrder, spool: Path, progress: Callable[[float, str], None]
) -> None:
    """Stream frames into the spool, see `kept_streams`.

    An event that does not come in its time leaves no frame there.

    Parameters
    ----------
    spool
        Folder of the job, without frames.
    progress
        Told a fraction and a few words a few times a second; may raise to stop, which keeps what is there.

    Raises
    ------
    InvalidInput
        The rig does not have a camera or the channel of the event, or the ring does not fit into memory.
    InstrumentError
        An instrument gives up; frames that flowed stay in the spool.
    StorageFull
        The spool's disk has no room for all of them, or is full on the way.
    """
    _require(rig, order, spool)
    with ExitStack() as stack:
        stack.callback(quietly, rig.lamp.off)
        for name in order.cameras:
            stack.callback(quietly, rig.cameras[name].disarm)
        rig.lamp.on()
        for name in order.cameras:
            rig.cameras[name].arm(order.exposure)
        _try_out(rig, order.cameras)
        moments, readings = LineLog(moments_path(spool)), LineLog(readings_path(spool))
        stack.callback(moments.close)
        stack.callback(readings.close)
        _Stream(rig, order, spool, moments, readings).run(progress)


@dataclass
class _Stream:
    """A stream while it runs. All times are by the clock of the rig."""

    rig: ConnectedRig
    order: StreamOrder
    spool: Path
    moments: LineLog
    readings: LineLog
    _stop: threading.Event = field(default_factory=threading.Event, init=False)
    _event_s: float | None = field(default=None, init=False)
    _taken: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        frames = self.order.size.ring_frames
        facts = {name: self.rig.cameras[name].facts for name in self.order.cameras}
        self._rings = {name: FrameRing(frames, f.rows, f.columns, f.dtype) for name, f in facts.items()}
        self._begun, self._zero = self.rig.clock.now(), self.rig.clock.monotonic()
        self._watch = ChannelWatch(
            self.rig.channels, self.rig.clock, self._zero, self.readings, self.order.event, self._come
        )
        if self.order.event is None:
            self._flow(self._zero)

    def run(self, progress: Callable[[float, str], None]) -> None:
        """Stream until the end; raise what a thread ended with, once all that flowed is written."""
        with ThreadPoolExecutor(len(self._rings) + 2, thread_name_prefix="stream") as threads:
            others = [threads.submit(self._watch.run)]
            others += [threads.submit(self._write, name) for name in self._rings]
            self._watch.wait_until_read_after(-inf, READINGS_APART_S)
            capture = threads.submit(self._capture)
            try:
                self._look_on(capture, others, progress)
                self._watch.wait_until_read_after(self.rig.clock.monotonic(), READINGS_APART_S)
            finally:
                self._stop.set()
                capture.exception()  # waits for it
                self._watch.stop()
                for ring in self._rings.values():
                    ring.close()
            for one in others:
                one.result()
        self.moments.end()

    def _look_on(
        self, capture: Future[None], others: Sequence[Future[None]], progress: Callable[[float, str], None]
    ) -> None:
        while not capture.done():
            for one in others:
                if one.done():
                    one.result()  # none ends before the capture unless it fails
            progress(*self._so_far())
            time.sleep(_LOOKS_EVERY_S)
        capture.result()

    def _so_far(self) -> tuple[float, str]:
        size, event, passed_s = self.order.size, self.order.event, self.rig.clock.monotonic() - self._zero
        if event is not None and self._event_s is None:
            return 0.0, f"waiting for {event}: {passed_s:.0f} s of {size.for_s:g} s"
        words = f"streaming {', '.join(self._rings)}: exposed {self._taken} times"
        return min(passed_s / size.for_s, 1.0) if event is None else 0.5, words

    def _come(self, time_s: float) -> None:
        """Keep what was before the event, and what comes after it."""
        logger.info("%s: %.3f s after the start", self.order.event, time_s - self._zero)
        self._event_s = time_s
        self._flow(time_s - (self.order.size.before_s or 0.0))

    def _flow(self, since_s: float) -> None:
        for ring in self._rings.values():
            ring.flow(since_s)

    def _capture(self) -> None:
        """Expose all cameras at each tick and keep what they deliver; ticks that are missed are left out."""
        clock, period_s = self.rig.clock, 1.0 / self.order.size.rate_hz
        first_s = clock.monotonic()
        cameras = {name: self.rig.cameras[name] for name in self.order.cameras}
        tick = 0
        while not self._stop.is_set():
            due_s = first_s + tick * period_s
            if self._over(tick, due_s):
                return
            if self._stop.wait(max(due_s - clock.monotonic(), 0.0)):
                return
            self._take(tick, cameras, period_s)
            tick = max(tick + 1, ceil((clock.monotonic() - first_s) / period_s - 0.5))

    def _over(self, tick: int, due_s: float) -> bool:
        size = self.order.size
        if size.after_s is None:
            return tick >= size.frames
        if self._event_s is not None:
            return due_s > self._event_s + size.after_s
        return due_s - self._zero > size.for_s

    def _take(self, tick: int, cameras: Mapping[str, Camera], period_s: float) -> None:
        fired = self.rig.fire(cameras)
        frames: dict[str, Frame] = {}
        for name, camera in cameras.items():
            try:
                frame = _frame(camera, fired[name], period_s)
            except FrameLost as error:
                logger.warning("%s", error)
                continue
            require_size(name, frame, camera.facts)
            frames[name] = frame
        apart = apart_s(frame.fired or fired[name] for name, frame in frames.items()) if frames else 0.0
        numbers = [f"{name}:{frame.number}" for name, frame in frames.items()]
        self.moments.write(tick, f"{apart:.9f}", *numbers)
        for name, frame in frames.items():
            self._rings[name].put(frame.number, frame.time_s, frame.image)
        self._taken += 1

    def _write(self, camera: str) -> None:
        """Write the frames of a camera once they flow."""
        ring = self._rings[camera]
        held = ring.take()
        if held is None:
            return
        with (
            SpoolWriter(frames_path(self.spool, camera), self._header(camera)) as writer,
            _synced_beside(writer),
        ):
            while held is not None:
                writer.append(held.number, held.time_s - self._zero, ring.image(held))
                ring.let_go(held)
                held = ring.take()

    def _header(self, camera: str) -> SpoolHeader:
        facts, simulation = self.rig.cameras[camera].facts, self.rig.simulation
        seen = None if simulation is None else SIMULATION.dump_python(simulation(camera), mode="json")
        about = {
            "rig": self.rig.name,
            "full_scale": facts.full_scale,
            "gain": facts.gain,
            "read_noise": facts.read_noise,
            "event_s": None if self._event_s is None else self._event_s - self._zero,
            "simulation": seen,
        }
        frames = self.order.size.most_frames
        return SpoolHeader(self._begun, facts.rows, facts.columns, facts.dtype, frames, about)


@contextmanager
def _synced_beside(writer: SpoolWriter) -> Iterator[None]:
    """Force what is written to the disk again and again, so that a slow disk does not hold up who writes.

    A process that is killed loses nothing of what is written, synced or not; a machine without power does.
    """
    over = threading.Event()

    def sync() -> None:
        while not over.wait(_SYNC_EVERY_S):
            writer.sync()

    with ThreadPoolExecutor(1, thread_name_prefix="sync") as thread:
        syncing = thread.submit(sync)
        try:
            yield
        finally:
            over.set()
        syncing.result()


def _try_out(rig: ConnectedRig, names: Sequence[str]) -> None:
    """Take a frame of every camera that nobody keeps, so that one that gives none is told at once.

    Raises `FrameLost`.
    """
    cameras = {name: rig.cameras[name] for name in names}
    rig.fire(cameras)
    for name, camera in cameras.items():
        require_size(name, camera.read(FRAME_TIMEOUT_S), camera.facts)


def _frame(camera: Camera, fired: Fired, period_s: float) -> Frame:
    """Return the frame of a trigger; one that comes late is not taken for the next. Raises `FrameLost`."""
    timeout_s = min(max(2.0 * period_s, _LEAST_TIMEOUT_S), FRAME_TIMEOUT_S)
    while True:
        frame = camera.read(timeout_s)
        if frame.fired is not None or frame.time_s >= fired.not_before_s - 0.5 * period_s:
            return frame


def _require(rig: ConnectedRig, order: StreamOrder, spool: Path) -> None:
    """Raise where cameras, channel, memory or disk lack for a stream, before anything is exposed."""
    for name in order.cameras:
        if name not in rig.cameras:
            raise InvalidInput(f"rig {rig.name} has no camera {name}; it has {', '.join(rig.cameras)}")
    event, units = order.event, {name: channel.unit for name, channel in rig.channels.items()}
    if event is not None and units.get(event.channel) != event.unit:
        known = ", ".join(f"{name} in {unit}" for name, unit in units.items()) or "none"
        raise InvalidInput(
            f"rig {rig.name} has no channel {event.channel} in {event.unit}, which is waited for; it has "
            f"{known}"
        )
    bytes_each = {name: image_bytes(rig.cameras[name].facts) for name in order.cameras}
    advice = "keep less before the event, or take fewer frames a second"
    require_memory(order.size.ring_frames, bytes_each, advice)
    spool.mkdir(parents=True, exist_ok=True)
    needed, free = order.size.most_frames * sum(bytes_each.values()), shutil.disk_usage(spool).free
    if needed > free:
        raise StorageFull(
            f"the disk of the spool, {spool}, has {free / 1e6:.0f} MB left, and the frames of this stream "
            f"need {needed / 1e6:.0f} MB: free some space"
        )
