"""Frames on their way to the archive: what is complete stays, what is torn is not taken for whole."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.errors import ArchiveCorrupt, StorageFull
from sms_jobs.instruments.spool import Spooled, SpooledFrames, SpoolHeader, SpoolWriter

HEADER = SpoolHeader(datetime(2026, 5, 4, 10, 0, tzinfo=UTC), 24, 32, "uint16", 5, {"rig": "r", "gain": 0.25})
HEAD = 65_536  # bytes before the first frame
RECORD = 24 + 2 * 24 * 32  # head and image, in bytes


def images(rng: np.random.Generator, count: int = 5) -> np.ndarray:
    return rng.integers(0, 4096, (count, 24, 32), dtype=np.uint16)


def written(path: Path, frames: np.ndarray) -> None:
    with SpoolWriter(path, HEADER) as file:
        for k, image in enumerate(frames):
            file.append(7 + k, 0.5 * k, image)


def test_frames_come_back_as_they_were(tmp_path: Path, rng: np.random.Generator) -> None:
    frames = images(rng)
    written(tmp_path / "a", frames)
    found = Spooled(tmp_path / "a")
    assert found.header == HEADER
    assert found.finished
    np.testing.assert_array_equal([found.frame(k) for k in range(5)], frames)
    numbers, times = found.numbers_and_times(5)
    np.testing.assert_array_equal(numbers, [7, 8, 9, 10, 11])
    np.testing.assert_array_equal(times, [0.0, 0.5, 1.0, 1.5, 2.0])
    stack = SpooledFrames(found, 4)
    assert stack.shape == (4, 24, 32)
    assert stack.dtype == np.uint16
    np.testing.assert_array_equal(stack.rows(5, 9), frames[:4, 5:9])
    np.testing.assert_array_equal(stack.frame(-1), frames[3])
    with pytest.raises(IndexError):
        stack.frame(4)


@pytest.mark.parametrize("cut", range(0, 3 * RECORD, 97))
def test_a_torn_file_keeps_its_complete_frames(tmp_path: Path, rng: np.random.Generator, cut: int) -> None:
    frames = images(rng)
    written(tmp_path / "a", frames)
    os.truncate(tmp_path / "a", (tmp_path / "a").stat().st_size - cut)
    found = Spooled(tmp_path / "a")
    assert found.complete == 5 - -(-cut // RECORD)
    assert found.finished == (cut == 0)
    np.testing.assert_array_equal([found.frame(k) for k in range(found.complete)], frames[: found.complete])


def test_a_last_frame_that_is_not_as_it_was_written_is_left_out(tmp_path: Path) -> None:
    written(tmp_path / "a", np.zeros((5, 24, 32), np.uint16))
    # A loss of power leaves blocks of zeros, or of anything, at the end of a file.
    with (tmp_path / "a").open("r+b") as file:
        file.seek(-100, os.SEEK_END)
        file.write(b"x")
    assert Spooled(tmp_path / "a").complete == 4


def test_a_changed_frame_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    written(tmp_path / "a", images(rng))
    with (tmp_path / "a").open("r+b") as file:
        file.seek(HEAD + RECORD + 100)
        byte = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte[0] ^ 1]))
    found = Spooled(tmp_path / "a")
    found.frame(0)
    with pytest.raises(ArchiveCorrupt, match="frame 2 of"):
        found.frame(1)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"sms-spool 1\n",
        b"other".ljust(5000),
        b"sms-spool 1\n{}".ljust(HEAD),
        b"sms-spool 1\n[".ljust(HEAD),
    ],
)
def test_a_file_without_header_is_no_spool(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(ArchiveCorrupt, match="holds no frames"):
        Spooled(tmp_path / "a")


def test_nothing_is_written_over(tmp_path: Path, rng: np.random.Generator) -> None:
    written(tmp_path / "a", images(rng))
    with pytest.raises(FileExistsError):
        SpoolWriter(tmp_path / "a", HEADER)
    with SpoolWriter(tmp_path / "b", HEADER) as file, pytest.raises(ValueError, match="a frame of"):
        file.append(1, 0.0, np.zeros((2, 2), np.uint16))


KILLED = """
import sys, numpy as np
from datetime import UTC, datetime
from pathlib import Path
from sms_jobs.instruments.spool import SpoolHeader, SpoolWriter
header = SpoolHeader(datetime(2026, 5, 4, tzinfo=UTC), 512, 512, "uint16", 100000, {})
file = SpoolWriter(Path(sys.argv[1]), header)
for k in range(100000):
    file.append(k, float(k), np.full((512, 512), k % 4096, np.uint16))
    print(k, flush=True)
"""


def test_a_killed_process_leaves_every_frame_that_it_had_written(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "a")], stdout=subprocess.PIPE)
    assert process.stdout is not None
    told = [process.stdout.readline() for _ in range(20)]
    process.send_signal(signal.SIGKILL)
    told += process.stdout.readlines()
    process.stdout.close()
    process.wait()
    found = Spooled(tmp_path / "a")
    assert found.complete >= len([line for line in told if line.endswith(b"\n")])
    for k in range(found.complete):
        assert (found.frame(k) == k % 4096).all()


def test_a_full_disk_is_told(tmp_path: Path) -> None:
    header = SpoolHeader(HEADER.recorded_at, 512, 512, "uint16", 2, {})
    with SpoolWriter(tmp_path / "a", header) as file:
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (HEAD + 1000, before[1]))
        try:
            with pytest.raises(StorageFull, match="free some space"):
                file.append(1, 0.0, np.zeros((512, 512), np.uint16))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            signal.signal(signal.SIGXFSZ, ignored)
    assert Spooled(tmp_path / "a").complete == 0
