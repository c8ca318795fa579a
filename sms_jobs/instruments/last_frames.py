"""The newest frame that a recording has brought into a spool, while it goes on or after it broke off."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.instruments.kept_streams import readings_path
from sms_jobs.instruments.spool import Spooled

_TAIL_BYTES = 65_536
"""Of the log of readings: its end."""


@dataclass(frozen=True)
class SpooledFrame:
    """A frame of a spool.

    Attributes
    ----------
    view
        Of which it is, as its file is named.
    image
        (rows, columns), in grey levels.
    full_scale
        Grey level at which the camera saturates.
    number, frames
        Which one of its file it is, counted from 1, and how many that is to hold.
    taken_at
        With time zone.
    channels
        What was read last, by name, in the unit of the name.
    """

    view: str
    image: NDArray[Any]
    full_scale: int
    number: int
    frames: int
    taken_at: datetime
    channels: dict[str, float]


def newest_frame(spool: Path) -> SpooledFrame | None:
    """Return the last complete frame of the file that was written to last; None where there is none.

    Files may come and go meanwhile.
    """
    for path in _newest_first(spool):
        try:
            file = Spooled(path)
            if not file.complete:
                continue
            last, (_, times) = file.complete - 1, file.numbers_and_times(file.complete)
            image = file.frame(last)
        except (ArchiveCorrupt, FileNotFoundError):
            continue  # a log or a file of facts; or its recording was archived a moment ago
        about = file.header.about
        return SpooledFrame(
            path.name.partition(".")[0],
            image,
            int(about["full_scale"]),
            last + 1,
            file.header.frames,
            file.header.recorded_at + timedelta(seconds=float(times[last])),
            {**about.get("channels", {}), **_last_readings(readings_path(spool))},
        )
    return None


def _newest_first(spool: Path) -> Iterator[Path]:
    found = []
    for path in spool.glob("*"):
        try:
            found.append((path.stat().st_mtime_ns, path))
        except FileNotFoundError:
            continue
    return (path for _, path in sorted(found, reverse=True))


def _last_readings(log: Path) -> dict[str, float]:
    """Return what a log of readings tells last of each channel; nothing where there is none."""
    try:
        with log.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(max(0, size - _TAIL_BYTES))
            text = file.read().decode("utf-8", "replace")
    except FileNotFoundError:
        return {}
    found = {}
    # The first line may be cut off here, the last by whoever writes it.
    for line in text.split("\n")[1 if size > _TAIL_BYTES else 0 : -1]:
        name, _, value = line.split()
        found[name] = float(value)
    return found
