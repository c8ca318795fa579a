"""From the window of a projector to the frames of a camera, through the drivers of real ones.

The pixels of an X server in memory are photographed into numbered images, which OpenCV captures: light and
lens are missing, nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from math import pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.display import COLUMNS, ROWS, Display, display

from sms_jobs.instruments.cameras import opencv
from sms_jobs.instruments.cameras.opencv import OpencvSettings
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import recorded
from sms_jobs.instruments.optical_drivers import DriverContext
from sms_jobs.instruments.projectors import window
from sms_jobs.instruments.projectors.window import WindowSettings
from sms_jobs.instruments.protocols import Camera, Fired, SoftwareTrigger
from sms_jobs.instruments.recorder import record_state
from sms_jobs.records.measurement import FringeSequence

SEQUENCE = FringeSequence((5, 4), 4, (0.0, pi / 2))


@dataclass
class Photographer:
    """Writes what is on the display, at half its brightness, as the camera's next image."""

    display: Display
    folder: Path
    taken: int = 0

    def fire(self, cameras: Mapping[str, Camera]) -> Mapping[str, Fired]:
        cv2.imwrite(str(self.folder / f"{self.taken:03d}.png"), self.display.grab()[:, :, 0] // 2)
        self.taken += 1
        return SoftwareTrigger(RealClock()).fire(cameras)


def test_what_is_projected_is_what_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = tmp_path / "seen"
    seen.mkdir()
    with display(tmp_path) as hidden, ExitStack() as ending:
        monkeypatch.setenv("DISPLAY", hidden.name)
        monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
        place = DriverContext(RealClock(), ending)
        projector = window.connect(WindowSettings("P1", COLUMNS, ROWS, "window", settle_ms=0.0), place)
        photographer = Photographer(hidden, seen)
        # OpenCV counts the images first, and reads each in its turn.
        for number in range(SEQUENCE.frames + 2):
            cv2.imwrite(str(seen / f"{number:03d}.png"), np.zeros((ROWS, COLUMNS), np.uint8))
        photographer.fire({})  # a camera is looked through once when it is connected
        camera = opencv.connect(
            OpencvSettings("C1", COLUMNS, ROWS, "opencv", 0.1, 1.0, str(seen / "%03d.png"), discarded=0),
            place,
        )
        rig = ConnectedRig("desk", {"C1": camera}, {"P1": projector}, place.clock, photographer)
        record_state(rig, ("C1P1",), SEQUENCE, tmp_path / "spool", Limits(), lambda f, words: None)
        measurement, recording = recorded(tmp_path / "spool", "C1P1", SEQUENCE)
        assert (hidden.grab() == 0).all()
    assert photographer.taken == 1 + SEQUENCE.frames + 1
    assert (measurement.texture == 127).all()
    assert recording.verdict.doubts == ()
    assert list(recording.numbers) == list(range(1, SEQUENCE.frames + 2))
    steps = measurement.frames.rows(0, ROWS).astype(np.float64)
    # Orientation by orientation, density by density: four steps of a quarter turn each.
    for first, density, along in ((0, 5, "x"), (4, 4, "x"), (8, 5, "y"), (12, 4, "y")):
        i0, i1, i2, i3 = steps[first : first + 4]
        phase = np.arctan2(i3 - i1, i0 - i2)
        n, pixels = (COLUMNS, np.arange(COLUMNS)) if along == "x" else (ROWS, np.arange(ROWS)[:, None])
        wanted = 2.0 * pi * density * (pixels + 0.5 - n / 2) / n
        # Rounding and halving put a level -3/4 .. 1/4 off, each of two differences of up to 127.5 by up to 1.
        assert np.abs(np.exp(1j * phase) - np.exp(1j * wanted)).max() <= 2.0**0.5 / 127.5
