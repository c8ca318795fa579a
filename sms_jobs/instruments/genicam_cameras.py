"""Cameras that speak GenICam, whoever carries the words: features by their standard names, frames by number.

A driver offers the features of a camera and a stream of what it delivers; the rest is the same for every make
and is here: setting up, triggering, exposing, counting, unpacking.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, FrameLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs.pixel_formats import BITS, unpacked
from sms_jobs.instruments.genicam_settings import ACQUISITION, SOFTWARE, GenicamSettings
from sms_jobs.instruments.protocols import CameraFacts, Frame
from sms_jobs.instruments.real_cameras import checked_image
from sms_jobs.records.bursts import Burst

logger = logging.getLogger(__name__)

Value: TypeAlias = bool | int | float | str
_MOST_UNASKED = 100
"""Frames that are thrown away at once: noise on a line must not hold a recording up for ever."""
_BUFFERS = 4
_SPARE_BUFFERS = 2
"""Of a burst, for frames that nobody expects."""
_LAST_NUMBER = 65535
"""After which GigE Vision counts from 1 again."""


class Features(Protocol):
    """The features of a camera. All methods raise `LinkLost` or `DeviceFault`."""

    def has(self, name: str) -> bool:
        """Say whether the camera has a feature now."""
        ...

    def get(self, name: str) -> Value:
        """Return the value of a feature."""
        ...

    def set(self, name: str, value: Value) -> None:
        """Set a feature."""
        ...

    def limits(self, name: str) -> tuple[float, float]:
        """Return the least and the greatest value of a number."""
        ...

    def execute(self, name: str) -> None:
        """Execute a command."""
        ...


@dataclass(frozen=True)
class Delivered:
    """What a camera delivered.

    Attributes
    ----------
    number
        By its own count.
    time_s
        By its own clock; None where it tells none.
    data
        Bytes of the image, in a buffer that is used again.
    problem
        What is missing of it; empty for a complete frame.
    """

    number: int
    time_s: float | None
    data: NDArray[np.uint8]
    problem: str = ""


class Stream(Protocol):
    """Frames of a camera. All methods raise `LinkLost` or `DeviceFault`."""

    def start(self, buffers: int) -> None:
        """Begin an acquisition with room for so many frames; nothing of one before is left."""
        ...

    def stop(self) -> None:
        """End it."""
        ...

    def take(self, timeout_s: float, use: Callable[[Delivered], None]) -> bool:
        """Hand over the oldest frame that was not taken; return False when none comes in time."""
        ...

    def close(self) -> None:
        """Let go of the camera; may be called again."""
        ...


class GenicamCamera:
    """A camera that is triggered for each frame.

    Raises
    ------
    LinkLost
        When it does not answer.
    DeviceFault
        When it refuses what it is to be set to, or has not the features that are needed.
    """

    def __init__(self, settings: GenicamSettings, features: Features, stream: Stream, clock: Clock) -> None:
        self._settings = settings
        self._features = features
        self._stream = stream
        self._clock = clock
        self._streaming = False
        self._bursting = False
        self._last: int | None = None
        """Number of the last frame by the camera's count of this acquisition."""
        self._number = 0
        self._clocks_apart_s: float | None = None
        self._exposure_s = 0.0
        self._set_up()

    @property
    def facts(self) -> CameraFacts:
        """What does not change about it."""
        return self._settings.facts(BITS[self._settings.pixel_format])

    def describe(self) -> str:
        """Return make, number and how it is set."""
        features, settings = self._features, self._settings
        known = [
            str(features.get(name))
            for name in ("DeviceVendorName", "DeviceModelName", "DeviceVersion")
            if features.has(name)
        ]
        words = [f"{' '.join(known)}, {settings.device}" if known else settings.device]
        words.append(f"{settings.columns} x {settings.rows} pixels {settings.pixel_format}")
        if settings.exposure_ms:
            words.append(f"exposed for {settings.exposure_ms:g} ms")
        words.append(f"triggered by {settings.trigger}")
        if settings.pulse_line:
            words.append(f"by pulses on {settings.pulse_line}")
        return ", ".join(words)

    def arm(self, exposure: float) -> None:
        """Make ready to be triggered, and set the exposure.

        Raises
        ------
        DeviceFault
            When the camera cannot expose so long, or its settings give no exposure of its own.
        """
        self._ready(exposure)
        if self._settings.trigger != ACQUISITION:
            self._set("TriggerSource", self._source)
            self._begin()

    def arm_burst(self, burst: Burst) -> None:
        """Make ready to be exposed by every pulse on its line, with a buffer for each frame.

        The acquisition stays continuous: one of so many frames would not tell of a pulse too many.
        """
        self._ready(burst.exposure)
        self._set("TriggerSource", self._settings.pulse_line)
        self._bursting = True
        self._begin(burst.frames + _SPARE_BUFFERS)

    def left_over(self, timeout_s: float) -> int:
        """Return how many frames were not read, and forget them; wait for one where there is none."""
        left: list[int] = []
        for _ in range(_MOST_UNASKED):
            if not self._stream.take(0.0 if left else timeout_s, lambda one: left.append(one.number)):
                break
        return len(left)

    def trigger(self) -> None:
        """Take a frame, or make ready for the wire; what came without being asked for is thrown away."""
        if self._settings.trigger == ACQUISITION:
            self._halt()
            self._begin()
            return
        self._forget()
        if self._settings.trigger == SOFTWARE:
            self._features.execute("TriggerSoftware")

    def read(self, timeout_s: float) -> Frame:
        """Return the oldest frame that was not read.

        Raises
        ------
        FrameLost
            When none comes, or one that is not complete; frames that come late are not taken for others.
        """
        name, frames = self._settings.name, list[Frame]()
        problem = f"camera {name} delivered no frame within {timeout_s:g} s of its trigger"

        def use(delivered: Delivered) -> None:
            nonlocal problem
            if delivered.problem:
                problem = f"camera {name} delivered a frame that is not complete: {delivered.problem}"
            else:
                frames.append(self._frame(delivered))

        if self._streaming:
            self._stream.take(timeout_s + self._exposure_s, use)
        if self._settings.trigger == ACQUISITION:
            self._halt()
        if not frames:
            if self._streaming and not self._bursting:
                self._halt()
                self._begin()
            raise FrameLost(problem)
        return frames[0]

    def disarm(self) -> None:
        """Stop taking frames, whatever state it is in."""
        self._halt()

    def close(self) -> None:
        """Let go of it."""
        self._stream.close()

    def _forget(self) -> None:
        """Throw away frames that nobody asked for; the numbers of those that follow tell of them."""
        unasked = self.left_over(0.0) if self._streaming else 0
        if unasked:
            logger.warning(
                "camera %s delivered %d frames without being triggered: look for noise on its line",
                *(self._settings.name, unasked),
            )

    def _ready(self, exposure: float) -> None:
        self._halt()
        self._clocks_apart_s = None  # clocks drift
        self._expose(exposure)

    def _begin(self, buffers: int = _BUFFERS) -> None:
        self._last = None
        self._stream.start(buffers)
        self._streaming = True

    def _halt(self) -> None:
        self._bursting = False
        if self._streaming:
            self._streaming = False
            self._stream.stop()

    def _frame(self, delivered: Delivered) -> Frame:
        settings = self._settings
        image = unpacked(delivered.data, settings.pixel_format, settings.columns, settings.rows)
        self._number += 1 if self._last is None else steps_between(self._last, delivered.number)
        self._last = delivered.number
        return Frame(self._number, self._rig_time(delivered), checked_image(settings.name, image, self.facts))

    def _rig_time(self, delivered: Delivered) -> float:
        """Return when a frame was exposed, by the clock of the rig.

        The clocks are as far apart as the frame that took the shortest way says: others were only under way
        for longer. In a burst the first frame says it, so that the times between frames are the camera's own.
        """
        now = self._clock.monotonic()
        if delivered.time_s is None:
            if self._bursting:
                raise DeviceFault(
                    f"camera {self._settings.name} tells no times of its frames, by which a burst is "
                    "checked: take it out of `pulses` in the rig file"
                )
            return now
        apart = now - delivered.time_s
        if self._clocks_apart_s is None or (apart < self._clocks_apart_s and not self._bursting):
            self._clocks_apart_s = apart
        return delivered.time_s + self._clocks_apart_s

    def _set_up(self) -> None:
        settings = self._settings
        for name, value in settings.features.items():
            self._set(name, value)
        self._set_if_there("AcquisitionMode", "Continuous")
        self._set("PixelFormat", settings.pixel_format)
        for name in ("OffsetX", "OffsetY"):  # or the region may be too large for where it is
            self._set_if_there(name, 0)
        self._set("Width", settings.columns)
        self._set("Height", settings.rows)
        for name, offset in (("OffsetX", settings.offset_x), ("OffsetY", settings.offset_y)):
            if offset:
                self._set(name, offset)
        self._set_if_there("ExposureMode", "Timed")
        self._set_if_there("ExposureAuto", "Off")
        self._set_if_there("GainAuto", "Off")
        if settings.gain is not None:
            gain, raw = self._one_of("Gain", "GainRaw"), int(settings.gain)
            self._set(gain, raw if gain == "GainRaw" and raw == settings.gain else settings.gain)
        self._expose(1.0)
        if settings.trigger == ACQUISITION:
            self._set_if_there("TriggerMode", "Off")
            return
        if not self._features.has("TriggerMode"):
            raise DeviceFault(
                f'camera {settings.name} cannot be triggered: say trigger = "{ACQUISITION}" in the rig file, '
                "which begins an acquisition for every frame"
            )
        self._set_if_there("TriggerSelector", "FrameStart")
        self._set("TriggerMode", "On")
        if settings.pulse_line:
            self._set("TriggerSource", settings.pulse_line)  # refused now rather than while a load is held
        self._set("TriggerSource", self._source)

    @property
    def _source(self) -> str:
        return "Software" if self._settings.trigger == SOFTWARE else self._settings.trigger

    def _expose(self, exposure: float) -> None:
        name, own_ms = self._settings.name, self._settings.exposure_ms
        if not own_ms:
            if exposure != 1.0:
                raise DeviceFault(
                    f"camera {name} is to expose {exposure:g} times as long as usual, and its rig file "
                    f"has no exposure: give exposure_ms, or record with one exposure"
                )
            return
        feature = self._one_of("ExposureTime", "ExposureTimeAbs")
        requested_us = 1e3 * own_ms * exposure
        self._set(feature, requested_us)
        taken = float(self._features.get(feature))
        # A line of the sensor more or less is what cameras round to.
        if abs(taken - requested_us) > max(50.0, 0.01 * requested_us):
            raise DeviceFault(
                f"camera {name} is to expose for {requested_us / 1e3:g} ms and says {taken / 1e3:g} ms: "
                "choose an exposure that it has"
            )
        self._exposure_s = taken / 1e6

    def _one_of(self, *names: str) -> str:
        for name in names:
            if self._features.has(name):
                return name
        raise DeviceFault(
            f"camera {self._settings.name} has no feature {' or '.join(names)}: remove it from the rig file"
        )

    def _set_if_there(self, name: str, value: Value) -> None:
        if self._features.has(name):
            self._set(name, value)

    def _set(self, name: str, value: Value) -> None:
        camera, features = self._settings.name, self._features
        if not features.has(name):
            raise DeviceFault(f"camera {camera} has no feature {name}, which is to be {value}")
        if isinstance(value, int | float) and not isinstance(value, bool):
            low, high = features.limits(name)
            if not low <= value <= high:
                raise DeviceFault(
                    f"camera {camera} is to have {name} = {value:g}, and allows {low:g} to {high:g}: "
                    "correct the rig file"
                )
        if self._is(name, value):
            return  # which spares what cannot be set and need not
        try:
            features.set(name, value)
        except DeviceFault as error:
            raise DeviceFault(f"{error}, when {name} was to be {value}; correct the rig file") from error

    def _is(self, name: str, value: Value) -> bool:
        try:
            return self._features.get(name) == value
        except DeviceFault:  # not readable
            return False


def steps_between(before: int, after: int) -> int:
    """Return by how many frames a camera went on, by its own numbers; 1 where none is missing."""
    if after > before:
        return after - before
    return max(1, after + _LAST_NUMBER - before)
