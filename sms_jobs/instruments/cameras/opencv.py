"""Cameras that OpenCV captures from: webcams, video streams, and files in their place.

Nobody triggers them: they run by themselves, and a trigger is the moment after which a frame counts. What
was buffered or was being exposed at that moment is thrown away.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, FrameLost, InvalidInput, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.optical_drivers import CameraDriver, DriverContext
from sms_jobs.instruments.protocols import CameraFacts, Fired, Frame
from sms_jobs.instruments.real_cameras import RealCamera, checked_image

_EXPOSURE_UNIT_MS = 0.1
"""Video for Linux counts exposures so."""
_MANUAL = 1
_LINUX = "V4L2"


@dataclass(frozen=True)
class OpencvSettings(RealCamera):
    """A camera that OpenCV captures from.

    Attributes
    ----------
    source
        Number of a webcam, its device file, the address of a stream, a video file, or numbered images such
        as `frames/%04d.png`.
    bits
        Of a grey level; more than 8 need a format that has them.
    fourcc
        Format that is asked for, four letters such as "GREY", "Y16 ", "YUYV"; empty for the camera's own.
    exposure_ms
        Set at the exposure 1 of a sequence, without automatic exposure; 0 leaves the camera as it is, which
        then knows that exposure alone.
    discarded
        Frames that are thrown away after each trigger.
    """

    driver: Literal["opencv"]
    source: int | str = 0
    bits: int = 8
    fourcc: str = ""
    exposure_ms: float = 0.0
    discarded: int = 6

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 8 <= self.bits <= 16 or not 0 <= self.discarded <= 1000:
            raise InvalidInput(
                f"camera {self.name} has grey levels of {self.bits} bits and discards {self.discarded} "
                "frames: from 8 to 16 bits and from 0 to 1000 frames are possible"
            )
        if len(self.fourcc) not in (0, 4) or not self.fourcc.isascii():
            raise InvalidInput(
                f"camera {self.name} is asked for the format '{self.fourcc}': it has four letters"
            )
        if self.exposure_ms and not _EXPOSURE_UNIT_MS <= self.exposure_ms <= 60e3:
            raise InvalidInput(
                f"camera {self.name} is to expose for {self.exposure_ms} ms: from {_EXPOSURE_UNIT_MS:g} to "
                "60000 ms are possible, or 0 for its own exposure"
            )


class OpencvCamera:
    """A camera that runs by itself.

    Raises
    ------
    LinkLost
        When there is no such source.
    DeviceFault
        When it does not deliver what the rig file says.
    """

    def __init__(self, settings: OpencvSettings, clock: Clock) -> None:
        import cv2

        self._cv2 = cv2
        self._settings = settings
        self._clock = clock
        self._asked = 0
        self._number = 0
        self._exposure_s = 0.0
        self._capture = self._opened()
        try:
            self._set_up()
            checked_image(settings.name, self._next(), self.facts)
        except BaseException:
            self.close()
            raise

    @property
    def facts(self) -> CameraFacts:
        """What does not change about it."""
        return self._settings.facts(self._settings.bits)

    def describe(self) -> str:
        """Return how it is reached and what it delivers."""
        facts, source = self.facts, self._settings.source
        return (
            f"{source} by {self._capture.getBackendName()}, {facts.columns} x {facts.rows} pixels of "
            f"{self._settings.bits} bits, triggered by software"
        )

    def close(self) -> None:
        """Let go of it."""
        self._capture.release()

    def arm(self, exposure: float) -> None:
        """Make ready to be triggered, and set the exposure.

        Raises
        ------
        DeviceFault
            When the camera cannot expose so long, or its settings give no exposure of its own.
        """
        self._asked = 0
        name, own = self._settings.name, self._settings.exposure_ms
        if own:
            self._expose(own * exposure)
        elif exposure != 1.0:
            raise DeviceFault(
                f"camera {name} is to expose {exposure:g} times as long as usual, and its rig file has no "
                f"exposure: give exposure_ms, or record with one exposure"
            )

    def trigger(self) -> None:
        """Ask for a frame that begins after this moment."""
        self._asked += 1

    def read(self, timeout_s: float) -> Frame:
        """Return the frame of the oldest trigger that was not read."""
        name = self._settings.name
        if not self._asked:
            raise FrameLost(f"camera {name} was not triggered")
        self._asked -= 1
        begun = self._clock.monotonic()
        for _ in range(self._settings.discarded):
            self._grab()
        last = self._clock.monotonic()  # when the frame before had come
        image = self._next()
        now = self._clock.monotonic()
        allowed = timeout_s + (self._settings.discarded + 1) * self._exposure_s
        if now > begun + allowed:
            raise FrameLost(f"camera {name} took {now - begun:.3g} s for a frame, more than {allowed:.3g} s")
        self._number += 1
        return Frame(self._number, now, checked_image(name, image, self.facts), Fired(last, now))

    def disarm(self) -> None:
        """Forget what was asked for."""
        self._asked = 0

    def _opened(self) -> Any:
        cv2, source = self._cv2, self._settings.source
        backend, what = cv2.CAP_ANY, source
        in_memory = isinstance(source, str) and source.startswith("/dev/shm/")  # noqa: S108 - files, no devices
        if isinstance(source, str) and source.startswith("/dev/") and not in_memory:
            number = re.fullmatch(r"video(\d+)", Path(source).resolve().name)
            if number is None:
                raise LinkLost(f"camera {self._settings.name} has no device {source}; check its cable")
            what, backend = int(number[1]), cv2.CAP_V4L2
        elif isinstance(source, str) and "%" in source:
            backend = cv2.CAP_IMAGES
        capture = cv2.VideoCapture(what, backend)
        if not capture.isOpened():
            raise LinkLost(
                f"camera {self._settings.name} cannot be opened at {source!r}; check its cable, that no "
                "other program uses it, and that this account may (on Linux the group video)"
            )
        return capture

    def _set_up(self) -> None:
        cv2, capture, settings = self._cv2, self._capture, self._settings
        if settings.fourcc:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*settings.fourcc))
        if settings.bits > 8:
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)  # which would make 8 bits of them
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, settings.columns)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.rows)
        if settings.exposure_ms:
            if capture.getBackendName() != _LINUX:
                raise DeviceFault(
                    f"camera {settings.name} is captured by {capture.getBackendName()}, which has no "
                    f"exposure in ms as {_LINUX} does: leave exposure_ms out, and set it with the camera's "
                    "program"
                )
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL)
            self._expose(settings.exposure_ms)

    def _expose(self, exposure_ms: float) -> None:
        requested = round(exposure_ms / _EXPOSURE_UNIT_MS)
        self._capture.set(self._cv2.CAP_PROP_EXPOSURE, requested)
        taken = self._capture.get(self._cv2.CAP_PROP_EXPOSURE)
        # A line of the sensor more or less is what cameras round to.
        if abs(taken - requested) > max(1.0, 0.02 * requested):
            raise DeviceFault(
                f"camera {self._settings.name} is to expose for {exposure_ms:g} ms and says "
                f"{taken * _EXPOSURE_UNIT_MS:g} ms: choose an exposure that it has"
            )
        self._exposure_s = taken * _EXPOSURE_UNIT_MS / 1e3

    def _grab(self) -> None:
        if not self._capture.grab():
            raise FrameLost(f"camera {self._settings.name} delivers no more frames")

    def _next(self) -> NDArray[Any]:
        self._grab()
        read, image = self._capture.retrieve()
        if not read:
            raise FrameLost(f"camera {self._settings.name} delivered a frame that cannot be decoded")
        return self._grey(image)

    def _grey(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return the brightness of an image: grey, YUV with the brightness first, or blue, green and red."""
        if image.ndim == 2:
            return image
        if image.shape[2] == 3:
            return np.asarray(self._cv2.cvtColor(image, self._cv2.COLOR_BGR2GRAY))
        return np.ascontiguousarray(image[:, :, 0])


def connect(camera: OpencvSettings, context: DriverContext) -> OpencvCamera:
    """Open a camera; raises as `OpencvCamera` does."""
    opened = OpencvCamera(camera, context.clock)
    context.ending.callback(opened.close)
    return opened


DRIVER = CameraDriver("opencv", OpencvSettings, connect)
