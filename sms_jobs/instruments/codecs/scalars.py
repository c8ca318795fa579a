"""Numbers in text: the reply of an instrument, the last line of a table."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from math import isfinite

from sms_jobs.errors import DeviceFault
from sms_jobs.records.instruments import FileChannel, SerialChannel


def reported_value(channel: SerialChannel, text: str) -> float | None:
    """Return the value of a reply in the channel's unit; None when the reply holds none.

    Raises
    ------
    DeviceFault
        The instrument reports in another unit than it is configured to.
    """
    match = re.search(channel.reply, text)
    if match is None:
        return None
    unit = (match.groupdict().get("unit") or "").strip()
    if channel.reported_unit and unit != channel.reported_unit:
        raise DeviceFault(
            f"'{channel.name}' reports in {unit or 'no unit'} and not in {channel.reported_unit}: set the "
            "instrument back, or change reported_unit and scale in the rig file"
        )
    return _scaled(match["value"], channel.scale, channel.offset)


def last_value(channel: FileChannel, head: str, tail: str) -> float | None:
    """Return the value in the last complete line of a table.

    Parameters
    ----------
    channel
        Says where it stands.
    head
        The beginning of the file, at least its first line.
    tail
        Its end; a line without an end is still being written, and a first line that may be cut is not used
        when it is not the file's.

    Raises
    ------
    DeviceFault
        The table has no such column.
    """
    lines = [line for line in tail[: tail.rfind("\n") + 1].splitlines() if line.strip()]
    headings = _cells(channel, head.split("\n", 1)[0])
    column = _column(channel, headings)
    if not lines:
        return None
    cells = _cells(channel, lines[-1])
    if column >= len(cells) or (cells == headings and channel.column in headings):
        return None
    return _scaled(cells[column].strip().replace(channel.decimal, "."), channel.scale, channel.offset)


def _cells(channel: FileChannel, line: str) -> list[str]:
    return next(csv.reader([line.strip("\ufeff\r\n")], delimiter=channel.delimiter), [])


def _column(channel: FileChannel, headings: Sequence[str]) -> int:
    names = [heading.strip() for heading in headings]
    if channel.column in names:
        return names.index(channel.column)
    if channel.column.isdecimal() and 1 <= int(channel.column) <= len(names):
        return int(channel.column) - 1
    raise DeviceFault(
        f"{channel.path}, which '{channel.name}' reads, has no column '{channel.column}': it has "
        f"{', '.join(names) or 'none'}; name one of these, or its number, in the rig file"
    )


def _scaled(text: str, scale: float, offset: float) -> float | None:
    try:
        value = scale * float(text) + offset
    except ValueError:
        return None
    return value if isfinite(value) else None
