"""What a stream of frames leaves in a spool, whether or not it came to its end, and how that is read.

Beside the frames of each camera lie two logs of lines: when the cameras were exposed together and which
frame of each came of it, and what the channels read. A line is written before the frame that it describes.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import ArchiveCorrupt, StorageFull
from sms_jobs.instruments.spool import Spooled

READINGS_APART_S = 2.0
"""Readings further apart than this say nothing of what was between them."""

_MOMENTS, _READINGS = "moments.log", "readings.log"
_FRAMES = ".stream"
_LINE_MODE = 0o600
_END = "end"


class LineLog:
    """A text of lines, each of which is written at once and survives the process."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, _LINE_MODE)

    def write(self, *words: object) -> None:
        """Add a line; raise `StorageFull` where the disk has no room for it."""
        line = " ".join(map(str, words)).encode() + b"\n"
        try:
            if os.write(self._descriptor, line) < len(line):
                raise StorageFull("the log of a stream cannot be kept: the disk is full; free some space")
        except OSError as error:
            raise StorageFull(
                f"the log of a stream cannot be kept: {error.strerror}; free some space"
            ) from error

    def end(self) -> None:
        """Say in a last line that nothing more is to come."""
        self.write(_END)

    def sync(self) -> None:
        """Force what was written to the disk."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Force everything to the disk and close it."""
        self.sync()
        os.close(self._descriptor)


def frames_path(spool: Path, camera: str) -> Path:
    """Return the file of a camera's frames."""
    return spool / f"{camera}{_FRAMES}"


def moments_path(spool: Path) -> Path:
    """Return the log of what was exposed."""
    return spool / _MOMENTS


def readings_path(spool: Path) -> Path:
    """Return the log of what channels read."""
    return spool / _READINGS


@dataclass(frozen=True)
class Moment:
    """When cameras were exposed together.

    Attributes
    ----------
    tick
        Which one it was, counted from 0; one that came too late is left out.
    apart_s
        How far apart they were exposed, at most.
    numbers
        What each camera that delivered a frame numbered it, by name.
    """

    tick: int
    apart_s: float
    numbers: Mapping[str, int]


@dataclass(frozen=True)
class Whole:
    """A moment of which the spool has a frame of every camera.

    Attributes
    ----------
    apart_s
        See `Moment`.
    places
        Where its frames are in the files of the cameras.
    time_s
        When it was, since the start of the stream: when its first camera was exposed.
    """

    apart_s: float
    places: Mapping[str, int]
    time_s: float


@dataclass(frozen=True)
class Account:
    """What became of the frames of one camera from the first moment that is kept to the last.

    Attributes
    ----------
    moments
        At which the cameras were exposed.
    late
        Times at which they should have been, and were not, because what came before took too long.
    lost
        Frames that the camera did not deliver.
    refused
        Frames for which there was no room in memory, because the disk was too slow.
    """

    moments: int
    late: int
    lost: int
    refused: int


@dataclass(frozen=True)
class KeptStream:
    """A stream as it lies in a spool.

    Attributes
    ----------
    files, counted
        The frames of each camera, and what it numbered them and when they were exposed.
    moments
        All of them, in order, from the first of which a frame is there.
    readings
        Times since the start of the stream and what was read then, by channel.
    ended
        Whether it came to its end, and did not break off.
    """

    files: Mapping[str, Spooled]
    counted: Mapping[str, tuple[NDArray[np.int64], NDArray[np.float64]]]
    moments: tuple[Moment, ...]
    readings: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    ended: bool

    def whole(self) -> tuple[Whole, ...]:
        """Return the moments of which every camera has a frame, in order."""
        places = self._places()
        return tuple(
            Whole(
                moment.apart_s,
                found := {name: places[name][number] for name, number in moment.numbers.items()},
                min(float(self.counted[name][1][place]) for name, place in found.items()),
            )
            for moment in self.moments
            if all(moment.numbers.get(name) in places[name] for name in self.files)
        )

    def account(self, camera: str) -> Account:
        """Return what became of the frames of a camera."""
        places = self._places()[camera]
        given = [moment.numbers[camera] for moment in self.moments if camera in moment.numbers]
        ticks = [moment.tick for moment in self.moments]
        return Account(
            len(ticks),
            ticks[-1] - ticks[0] + 1 - len(ticks),
            len(ticks) - len(given),
            sum(number not in places for number in given),
        )

    def values_at(self, time_s: float) -> dict[str, float]:
        """Return what the channels read at a time, by name: between the readings before and after it.

        A channel that was not read before and after, within `READINGS_APART_S`, has no value.
        """
        found = {name: value_at(times, values, time_s) for name, (times, values) in self.readings.items()}
        return {name: value for name, value in found.items() if value is not None}

    def _places(self) -> dict[str, dict[int, int]]:
        return {
            name: {number: place for place, number in enumerate(numbers.tolist())}
            for name, (numbers, _) in self.counted.items()
        }


def value_at(times_s: NDArray[np.float64], values: NDArray[np.float64], time_s: float) -> float | None:
    """Return the value on the line between the readings next to a time; None where there are not both.

    Parameters
    ----------
    times_s, values
        Readings (n,), the times increasing.
    """
    after = int(np.searchsorted(times_s, time_s))
    if after < len(times_s) and times_s[after] == time_s:
        return float(values[after])
    if not 0 < after < len(times_s) or times_s[after] - times_s[after - 1] > READINGS_APART_S:
        return None
    return float(np.interp(time_s, times_s[after - 1 : after + 1], values[after - 1 : after + 1]))


def kept_stream(spool: Path, cameras: Sequence[str]) -> KeptStream | None:
    """Return what a stream has left in a spool; None where there is no complete frame of every camera."""
    try:
        files = {name: Spooled(frames_path(spool, name)) for name in cameras}
    except (FileNotFoundError, ArchiveCorrupt):  # killed before, or while, the header was written
        return None
    if not all(file.complete for file in files.values()):
        return None
    lines = list(_lines(moments_path(spool)))
    ended = [_END] in lines
    moments = tuple(_moment(line) for line in lines if line != [_END])
    counted = {name: file.numbers_and_times(file.complete) for name, file in files.items()}
    numbers = {name: set(own.tolist()) for name, (own, _) in counted.items()}
    there = [
        place
        for place, moment in enumerate(moments)
        if any(number in numbers[name] for name, number in moment.numbers.items())
    ]
    # What was exposed after the last frame came into the spool was lost with the process, if that was killed.
    moments = moments[there[0] : None if ended else there[-1] + 1] if there else ()
    return KeptStream(files, counted, moments, _readings(readings_path(spool)), ended)


def _lines(path: Path) -> Iterator[list[str]]:
    """Yield the words of the complete lines of a log: the last may be torn."""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines(keepends=True):
        if line.endswith("\n"):
            yield line.split()


def _moment(line: Sequence[str]) -> Moment:
    tick, apart_s, *numbers = line
    parted = (one.partition(":") for one in numbers)
    return Moment(int(tick), float(apart_s), {name: int(number) for name, _, number in parted})


def _readings(path: Path) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    found: dict[str, list[tuple[float, float]]] = {}
    for name, time_s, value in _lines(path):
        found.setdefault(name, []).append((float(time_s), float(value)))
    return {
        name: (np.array([t for t, _ in read]), np.array([value for _, value in read]))
        for name, read in found.items()
    }
