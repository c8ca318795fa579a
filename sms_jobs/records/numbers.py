"""Numbers that can be stored, computed with, and shown everywhere."""

from __future__ import annotations

from math import isfinite
from typing import Final

from sms_jobs.errors import InvalidInput

LARGEST: Final = 1e15
"""Of any quantity in any unit."""
WHOLE: Final = 1 << 63
"""Whole numbers stay below in magnitude: what databases, files and kernels can hold."""


def checked_number(
    value: float | None, what: str, low: float = -LARGEST, high: float = LARGEST
) -> float | None:
    """Return a number; raise `InvalidInput`, saying what it is, when it is not finite or out of its range."""
    if value is not None and not low <= value <= high:
        raise InvalidInput(
            f"{what} is {_shown(value, low, high)}, and should be between {low:g} and {high:g}: correct it"
        )
    return value


def _shown(value: float, low: float, high: float) -> str:
    """Write a number that is out of its range, with as many digits as tell it from the bound it passes."""
    if abs(value) >= WHOLE and isinstance(value, int):
        return f"a whole number of {value.bit_length()} bits"
    short = f"{value:g}"
    return short if short not in (f"{low:g}", f"{high:g}") else repr(float(value))


def is_excessive(value: object) -> bool:
    """Say whether a value that somebody gave is a number with which nothing can be computed."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) >= WHOLE if isinstance(value, int) else not (isfinite(value) and abs(value) <= LARGEST)
