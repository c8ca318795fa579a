"""Units in which quantities are named and typed, and how many of its family's first one each is."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import pi
from typing import Final

from sms_jobs.errors import InvalidInput
from sms_jobs.records.numbers import checked_number

FAMILIES: Final[tuple[dict[str, float], ...]] = (
    {"mm": 1.0, "nm": 1e-6, "um": 1e-3, "cm": 10.0, "m": 1e3},
    {"N": 1.0, "kN": 1e3, "MN": 1e6},
    {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180.0},
    {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    {"Hz": 1.0, "kHz": 1e3},
    {"strain": 1.0, "millistrain": 1e-3, "microstrain": 1e-6},
    {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    {"B": 1.0, "bytes": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9},
)
"""Each for one quantity, in its own unit first."""
NO_UNIT: Final = "1"
"""Of a number that only counts, which is typed without a unit."""

_TYPED = re.compile(r"\s*(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\s\d]\S*)?\s*")


@dataclass(frozen=True)
class Typed:
    """A quantity as somebody has typed it.

    Attributes
    ----------
    text
        As it was typed.
    number, unit
        Of it; the unit is empty where none was given.
    """

    text: str
    number: float
    unit: str

    def in_unit(self, unit: str, what: str) -> float:
        """Return the number in a unit.

        Parameters
        ----------
        unit
            Such as N; one of no family is taken by itself alone.
        what
            It is, for the message.

        Raises
        ------
        InvalidInput
            No unit was given, or that of another quantity.
        """
        family = next((f for f in FAMILIES if unit in f), {unit: 1.0})
        among = f"{', '.join(family)}, such as {self.number:g}{unit}"
        if unit == NO_UNIT and not self.unit:
            return self.number
        if not self.unit:
            raise InvalidInput(f"{what} is '{self.text}', which has no unit: write it in {among}")
        if self.unit not in family:
            raise InvalidInput(
                f"{what} is '{self.text}', and '{self.unit}' is no unit of it: write it in {among}"
            )
        number = self.number * family[self.unit] / family[unit]
        checked_number(number, f"{what} in {unit}")
        return number


def typed(text: str, what: str) -> Typed:
    """Read a number and its unit, as 20kN or 10 s; raise `InvalidInput` where it is none."""
    found = _TYPED.fullmatch(text)
    if found is None:
        raise InvalidInput(
            f"{what} is '{text}', which is no quantity: write a number and its unit, such as 10s, 0.5mm "
            "or 20kN"
        )
    return Typed(text.strip(), float(found["number"]), found["unit"] or "")


def unit_of_name(name: str, unit: str) -> str:
    """Return the unit at the end of a name, N of load_n; `unit` where that is none of the same quantity."""
    family = next((f for f in FAMILIES if unit in f), {})
    stem, _, own = name.rpartition("_")
    return next((each for each in family if stem and each.lower() == own.lower()), unit)


def in_unit_of_name(name: str, number: float, unit: str) -> float:
    """Return a number in the unit of `unit_of_name`: 20 kN of load_n are 20000."""
    own = unit_of_name(name, unit)
    family = next((f for f in FAMILIES if unit in f), {})
    return number if own == unit else number * family[unit] / family[own]


def time_words(seconds: float) -> str:
    """Return a time as people type it, in the largest unit of which it is a whole number: 15 min."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds and seconds % size == 0.0:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"


def duration_s(text: str, what: str, low_s: float, high_s: float) -> float:
    """Return a time that somebody has typed, in s; raise `InvalidInput` where it is none or out of bounds."""
    seconds = typed(text, what).in_unit("s", what)
    checked_number(seconds, f"{what} in s", low_s, high_s)
    return seconds
