"""What OpenCV captures of videos and numbered images, which stand for a camera that runs by itself."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import DeviceFault, FrameLost, InvalidInput, LinkLost
from sms_jobs.formats.rig_configuration import SIMULATED_SENSORS, parse_rig
from sms_jobs.instruments.cameras.opencv import DRIVER, OpencvCamera, OpencvSettings, connect
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.optical_drivers import DriverContext

COLUMNS, ROWS = 64, 48
SETTINGS = OpencvSettings("C1", COLUMNS, ROWS, "opencv", 0.2, 1.5)


@pytest.fixture
def frames(rng: np.random.Generator) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (20, ROWS, COLUMNS), dtype=np.uint8)


@pytest.fixture
def video(frames: NDArray[np.uint8], tmp_path: Path) -> str:
    """A film of these frames that loses nothing (FFV1)."""
    path = str(tmp_path / "film.mkv")
    writer = cv2.VideoWriter(
        path, cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"FFV1"), 25, (COLUMNS, ROWS), isColor=False
    )
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def images(folder: Path, frames: NDArray[Any]) -> str:
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number:03d}.png"), frame)
    return str(folder / "%03d.png")


def opened(settings: OpencvSettings) -> OpencvCamera:
    return connect(settings, DriverContext(RealClock(), ExitStack()))


def test_frames_before_the_trigger_are_thrown_away(video: str, frames: NDArray[np.uint8]) -> None:
    camera = opened(replace(SETTINGS, source=video, discarded=3))
    camera.arm(1.0)
    # The first was looked at when the camera was opened; then three of each four are discarded.
    for number in (4, 8, 12):
        camera.trigger()
        frame = camera.read(5.0)
        np.testing.assert_array_equal(frame.image, frames[number])
        assert frame.number == number // 4
    assert camera.facts.full_scale == 255


def test_numbers_and_times_go_on_over_exposures(video: str) -> None:
    camera = opened(replace(SETTINGS, source=video, discarded=0))
    got = []
    for _ in range(3):
        camera.arm(1.0)
        camera.trigger()
        camera.trigger()
        got += [camera.read(5.0), camera.read(5.0)]
    camera.disarm()
    assert [frame.number for frame in got] == [1, 2, 3, 4, 5, 6]
    times = [frame.time_s for frame in got]
    assert times == sorted(times)


def test_grey_levels_of_twelve_bits_are_kept(tmp_path: Path, rng: np.random.Generator) -> None:
    frames = rng.integers(0, 4096, (2, ROWS, COLUMNS)).astype(np.uint16)
    settings = replace(SETTINGS, source=images(tmp_path, frames), bits=12, discarded=0)
    camera = opened(settings)
    camera.arm(1.0)
    camera.trigger()
    np.testing.assert_array_equal(camera.read(5.0).image, frames[1])
    assert (camera.facts.full_scale, camera.facts.dtype) == (4095, "uint16")
    with pytest.raises(DeviceFault, match=r"delivers the grey level \d+, above the full scale 1023"):
        opened(replace(settings, bits=10))
    with pytest.raises(DeviceFault, match="delivers grey levels as uint16, the rig file says uint8"):
        opened(replace(settings, bits=8))


def test_colours_become_their_brightness(tmp_path: Path) -> None:
    picture = np.zeros((ROWS, COLUMNS, 3), np.uint8)
    picture[:, :, 1] = 200
    camera = opened(replace(SETTINGS, source=images(tmp_path, np.stack([picture] * 2)), discarded=0))
    camera.arm(1.0)
    camera.trigger()
    # ITU-R BT.601: 0.587 of green; a level of rounding.
    assert np.abs(camera.read(5.0).image - 0.587 * 200.0).max() <= 1.0


def test_a_frame_that_does_not_come_is_lost(tmp_path: Path, frames: NDArray[np.uint8]) -> None:
    camera = opened(replace(SETTINGS, source=images(tmp_path, frames[:2]), discarded=0))
    camera.arm(1.0)
    with pytest.raises(FrameLost, match="C1 was not triggered"):
        camera.read(5.0)
    camera.trigger()
    camera.read(5.0)
    camera.trigger()
    with pytest.raises(FrameLost, match="C1 delivers no more frames"):
        camera.read(5.0)
    camera.trigger()
    camera.disarm()
    with pytest.raises(FrameLost, match="was not triggered"):
        camera.read(5.0)


@pytest.mark.parametrize("source", ["/dev/no-such-camera", "nothing.mkv", "rtsp://127.0.0.1:9/none", 93])
def test_a_camera_that_is_not_there(source: int | str) -> None:
    with pytest.raises(LinkLost, match="camera C1"):
        opened(replace(SETTINGS, source=source))


def test_an_image_of_another_size_is_refused(video: str) -> None:
    with pytest.raises(DeviceFault, match=r"64 x 48 pixels, the rig file says 128 x 96"):
        opened(replace(SETTINGS, source=video, columns=128, rows=96))


def test_an_exposure_that_cannot_be_set_is_refused(video: str) -> None:
    with pytest.raises(DeviceFault, match="captured by FFMPEG, which has no exposure in ms"):
        opened(replace(SETTINGS, source=video, exposure_ms=20.0))
    with pytest.raises(DeviceFault, match="is to expose 4 times as long as usual, and its rig file has no"):
        opened(replace(SETTINGS, source=video)).arm(4.0)


@pytest.mark.parametrize(
    "wrong",
    [{"bits": 20}, {"fourcc": "MJPEG"}, {"exposure_ms": 0.01}, {"discarded": -1}, {"noise_gain": 0.0}],
)
def test_settings_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="camera C1"):
        replace(SETTINGS, **wrong)


def test_a_rig_file_describes_it(video: str) -> None:
    text = f"""
name = "desk"
[[cameras]]
name = "C1"
driver = "opencv"
columns = {COLUMNS}
rows = {ROWS}
noise_gain = 0.2
read_noise = 1.5
source = "{video}"
"""
    sensors = replace(SIMULATED_SENSORS, cameras={"opencv": DRIVER.record})
    (settings,) = parse_rig(text, "rig.toml", sensors).cameras
    assert isinstance(settings, OpencvSettings)
    assert settings == replace(SETTINGS, source=video)
    assert (
        opened(settings).describe() == f"{video} by FFMPEG, 64 x 48 pixels of 8 bits, triggered by software"
    )
