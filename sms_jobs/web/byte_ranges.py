"""Ranges of bytes as HTTP asks for them (RFC 9110, 14)."""

from __future__ import annotations

import re

_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


def range_of(header: str | None, size: int) -> tuple[int, int] | None:
    """Return beginning and end of the one range that is asked for; None for the whole.

    Several ranges, and what is no range of bytes, are answered with the whole, as the standard allows.

    Raises `ValueError` for a range that has nothing of the file.
    """
    found = _RANGE.fullmatch((header or "").replace(" ", ""))
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        start, stop = max(size - int(found[2]), 0), size
    else:
        start, stop = int(found[1]), min(int(found[2] or size) + 1, size)
        if found[2] and int(found[2]) < start:
            return None
    if start >= stop:
        raise ValueError(header)
    return start, stop
