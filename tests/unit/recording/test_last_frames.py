"""The newest frame of a spool, and its picture: whole, of the right file, saturated where it is."""

from __future__ import annotations

import io
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import Image

from sms_jobs.formats.frame_pictures import frame_as_png
from sms_jobs.instruments.last_frames import newest_frame
from sms_jobs.instruments.spool import SpoolHeader, SpoolWriter

BEGAN = datetime(2026, 5, 4, 10, 0, tzinfo=UTC)
ABOUT = {"full_scale": 4095, "channels": {"load_n": 120.0}}


def frames(path: Path, values: list[int], modified_s: float) -> None:
    """Write frames of one grey level each, half a second apart."""
    with SpoolWriter(path, SpoolHeader(BEGAN, 24, 32, "uint16", 5, ABOUT)) as file:
        for place, value in enumerate(values):
            file.append(7 + place, 0.5 * place, np.full((24, 32), value, np.uint16))
    os.utime(path, (modified_s, modified_s))


def test_it_is_the_last_whole_one_of_the_file_that_was_written_to_last(tmp_path: Path) -> None:
    assert newest_frame(tmp_path) is None
    assert newest_frame(tmp_path / "none") is None
    frames(tmp_path / "C1P2.001.frames", [], 40.0)
    assert newest_frame(tmp_path) is None
    frames(tmp_path / "C1P1.001.interrupted", [10, 20], 20.0)
    frames(tmp_path / "C1P1.002.frames", [30, 40, 50], 30.0)
    (tmp_path / "C1P1.json").write_text("{}")
    found = newest_frame(tmp_path)
    assert found is not None
    assert (found.view, found.number, found.frames, found.full_scale) == ("C1P1", 3, 5, 4095)
    assert found.taken_at == BEGAN + timedelta(seconds=1.0)
    assert found.channels == {"load_n": 120.0}
    assert (found.image == 50).all()

    with (tmp_path / "C1P1.002.frames").open("r+b") as file:
        file.truncate(os.fstat(file.fileno()).st_size - 1)
    os.utime(tmp_path / "C1P1.002.frames", (30.0, 30.0))
    torn = newest_frame(tmp_path)
    assert torn is not None
    assert (torn.number, int(torn.image[0, 0])) == (2, 40)


def test_a_stream_tells_what_its_channels_read_last(tmp_path: Path) -> None:
    frames(tmp_path / "C1.stream", [10], 30.0)
    lines = [f"load_n {0.1 * place:.1f} {place}" for place in range(10_000)]  # more than the end that is read
    (tmp_path / "readings.log").write_text("\n".join([*lines, "extension_mm 1.0 0.25", "load_n 1.0 9"]))
    found = newest_frame(tmp_path)
    assert found is not None
    # The last line is still being written: what it would say is not known yet.
    assert found.channels == {"load_n": 9999.0, "extension_mm": 0.25}


def picture(image: np.ndarray, most_px: int) -> np.ndarray:
    with Image.open(io.BytesIO(frame_as_png(image, 1000.0, most_px))) as drawn:
        return np.asarray(drawn).astype(int)


def test_a_picture_is_grey_to_full_scale_and_red_where_any_pixel_beneath_saturates() -> None:
    image = np.zeros((50, 99), np.uint16)
    image[10:20, 10:20] = 500
    image[49, 98] = 1000  # a single pixel, in a block that is not whole
    whole = picture(image, 99)
    assert whole.shape == (50, 99, 3)
    assert whole[15, 15].tolist() == [127, 127, 127]  # 255 * 500 / 1000, rounded down
    assert (whole[..., 0] > whole[..., 1]).sum() == 1
    small = picture(image, 10)
    assert small.shape == (5, 10, 3)
    red = np.argwhere(small[..., 0] > small[..., 1])
    assert red.tolist() == [[4, 9]]
    assert picture(np.zeros((1, 1000), np.uint8), 300).shape == (1, 250, 3)
