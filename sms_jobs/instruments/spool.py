"""Frames on their way from a camera to the archive: one plain file a view on a local disk.

A frame is one record of fixed length, written with one call and guarded by a checksum, so that whatever
happens to the process every complete frame can be read again. Compressing, hashing and checking are done
later, from here, when nobody holds a load any more.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from sms_jobs.errors import ArchiveCorrupt, StorageFull

_MAGIC = b"sms-spool 1\n"
_HEADER_BYTES = 65_536
_RECORD = struct.Struct("<QdII")  # number, time, CRC-32 of all the rest, length of the image in bytes
_WHATEVER = 0o600


@dataclass(frozen=True)
class SpoolHeader:
    """What every frame of a file has in common.

    Attributes
    ----------
    recorded_at
        Start of the recording, with time zone.
    rows, columns, dtype
        Of a frame; dtype is "uint8" or "uint16".
    frames
        How many there are to be.
    about
        Plain values that whoever records wants to find again.
    """

    recorded_at: datetime
    rows: int
    columns: int
    dtype: str
    frames: int
    about: Mapping[str, Any]


class SpoolWriter:
    """Writes the frames of one view; what was written survives the process."""

    def __init__(self, path: Path, header: SpoolHeader) -> None:
        """Begin a new file; raise `FileExistsError` where there is one."""
        text = (
            _MAGIC
            + json.dumps(
                {**vars(header), "recorded_at": header.recorded_at.isoformat(), "about": dict(header.about)}
            ).encode()
        )
        if len(text) > _HEADER_BYTES:
            raise ValueError(f"the header of {path.name} has {len(text)} bytes, more than {_HEADER_BYTES}")
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, _WHATEVER)
        self._length = header.rows * header.columns * np.dtype(header.dtype).itemsize
        self._dtype = np.dtype(header.dtype).newbyteorder("<")
        self._write(text.ljust(_HEADER_BYTES))

    def append(self, number: int, time_s: float, image: NDArray[Any]) -> None:
        """Add a frame; raise `StorageFull` when the disk has no room for it."""
        data = np.ascontiguousarray(image, self._dtype).data.cast("B")
        if len(data) != self._length:
            raise ValueError(f"a frame of {len(data)} bytes in a file of frames of {self._length}")
        check = zlib_ng.crc32(data, zlib_ng.crc32(struct.pack("<Qd", number, time_s)))
        self._write(_RECORD.pack(number, time_s, check, len(data)), data)

    def _write(self, *parts: Any) -> None:
        views = [memoryview(p).cast("B") for p in parts]
        try:
            done = os.writev(self._descriptor, views)
            for view in views:  # a short write is rare: the disk is nearly full or a signal came
                while done < len(view):
                    done += os.write(self._descriptor, view[done:])
                done -= len(view)
        except OSError as error:
            raise StorageFull(f"the frames cannot be kept: {error.strerror}; free some space") from error

    def sync(self) -> None:
        """Force what was written to the disk, so that it survives the machine too."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Force everything to the disk and close the file."""
        self.sync()
        os.close(self._descriptor)

    def __enter__(self) -> SpoolWriter:
        """Return itself."""
        return self

    def __exit__(self, *problem: object) -> None:
        """Close the file, whatever happened."""
        self.close()


class Spooled:
    """The complete frames of a file, read as they are asked for; a `FrameStack` but for their number.

    Attributes
    ----------
    header
        As it was written.
    complete
        Number of frames that are whole.
    """

    def __init__(self, path: Path) -> None:
        """Open a file; raise `ArchiveCorrupt` when it has no header."""
        self._path = path
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
            self.header = _header(head, path)
            self._dtype = np.dtype(self.header.dtype).newbyteorder("<")
            self._image_bytes = self.header.rows * self.header.columns * self._dtype.itemsize
            self._stride = _RECORD.size + self._image_bytes
            size = os.fstat(file.fileno()).st_size
        self.complete = min(max(size - _HEADER_BYTES, 0) // self._stride, self.header.frames)
        # Frames are written in order, so that only the last can have been torn, by a loss of power.
        while self.complete and not self._whole(self.complete - 1):
            self.complete -= 1

    @property
    def finished(self) -> bool:
        """True when all frames that there were to be are there."""
        return self.complete == self.header.frames

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns); raise `ArchiveCorrupt` when it has changed on the disk."""
        number, time_s, check, data = self._record(index)
        if zlib_ng.crc32(data, zlib_ng.crc32(struct.pack("<Qd", number, time_s))) != check:
            raise ArchiveCorrupt(f"frame {index + 1} of {self._path} is not as it was written")
        return np.frombuffer(data, self._dtype).reshape(self.header.rows, self.header.columns)

    def numbers_and_times(self, frames: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return what the camera numbered the first frames, and when they were taken, (frames,) each."""
        with self._path.open("rb") as file:
            heads = [
                _RECORD.unpack(os.pread(file.fileno(), _RECORD.size, _HEADER_BYTES + i * self._stride))
                for i in range(frames)
            ]
        numbers = np.array([h[0] for h in heads], np.int64)
        return numbers, np.array([h[1] for h in heads], np.float64)

    def _record(self, index: int) -> tuple[int, float, int, bytes]:
        if not 0 <= index < self.header.frames:
            raise IndexError(index)
        with self._path.open("rb") as file:
            raw = os.pread(file.fileno(), self._stride, _HEADER_BYTES + index * self._stride)
        if len(raw) < self._stride:
            raise IndexError(index)
        number, time_s, check, _ = _RECORD.unpack_from(raw)
        return number, time_s, check, raw[_RECORD.size :]

    def _whole(self, index: int) -> bool:
        try:
            self.frame(index)
        except ArchiveCorrupt:
            return False
        return True


@dataclass(frozen=True)
class SpooledFrames:
    """Frames of a file that follow each other, as a `FrameStack`.

    Attributes
    ----------
    file
        Where they are.
    count
        How many of them.
    start
        The first of them.
    """

    file: Spooled
    count: int
    start: int = 0

    @property
    def shape(self) -> tuple[int, int, int]:
        """(frames, rows, columns)."""
        return self.count, self.file.header.rows, self.file.header.columns

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of one grey level."""
        return np.dtype(self.file.header.dtype)

    def frame(self, index: int) -> NDArray[Any]:
        """Return one frame, (rows, columns)."""
        return self.file.frame(self.start + range(self.count)[index])

    def rows(self, start: int, stop: int) -> NDArray[Any]:
        """Return a slab of every frame, (frames, stop - start, columns)."""
        return np.stack([self.frame(i)[start:stop] for i in range(self.count)])


def _header(head: bytes, path: Path) -> SpoolHeader:
    if not head.startswith(_MAGIC) or len(head) < _HEADER_BYTES:
        raise ArchiveCorrupt(f"{path} holds no frames: it has no header")
    try:
        fields = json.loads(head[len(_MAGIC) :])
        recorded_at = datetime.fromisoformat(fields.pop("recorded_at"))
        header = SpoolHeader(recorded_at=recorded_at, **fields)
        possible = header.dtype in ("uint8", "uint16") and min(header.rows, header.columns, header.frames) > 0
    except (ValueError, TypeError, KeyError) as error:
        raise ArchiveCorrupt(f"{path} holds no frames: {error}") from error
    if not possible:
        raise ArchiveCorrupt(
            f"{path} holds no frames: {header.frames} of {header.columns} x {header.rows} px"
        )
    return header
