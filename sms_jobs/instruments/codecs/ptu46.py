"""PTU-46 pan-tilt units: ASCII commands that end with a space, answered `* value` or `! reason`.

Positions and speeds are counts and counts per second; `pr` and `tr` tell the seconds of arc of a count.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import pi
from typing import Literal

AxisLetter = Literal["p", "t"]

BEGIN = ("ft", "ed", "ci")
"""Terse replies, no echo, commands are carried out at once."""
TERMINATOR = "\n"
_RADIANS_A_SECOND_OF_ARC = pi / (180.0 * 3600.0)
_REPLY = re.compile(r"(?P<mark>[*!])\s*(?P<text>.*)$")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?")


@dataclass(frozen=True)
class Reply:
    """What the unit answered: its text, its number if there is one, and whether it accepted."""

    accepted: bool
    text: str
    value: float | None


def command(name: str, value: int | None = None) -> bytes:
    """Return the bytes of a command such as `pp` (a question) or `pp-100`."""
    return f"{name}{'' if value is None else value} ".encode("ascii")


def reply(line: str) -> Reply | None:
    """Read a line; None when it is no reply."""
    match = _REPLY.search(line)
    if match is None:
        return None
    number = _NUMBER.search(match["text"])
    return Reply(match["mark"] == "*", match["text"].strip(), float(number[0]) if number else None)


def radians_per_count(seconds_of_arc: float) -> float:
    """Return the angle of a count from the resolution that the unit tells."""
    return seconds_of_arc * _RADIANS_A_SECOND_OF_ARC
