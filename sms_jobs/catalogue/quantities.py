"""Names with a unit at their end, and what to multiply with to ask in another unit."""

from __future__ import annotations

from collections.abc import Iterator
from math import pi

_UNITS: tuple[dict[str, float], ...] = (
    {"nm": 1e-6, "um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3},
    {"n": 1.0, "kn": 1e3, "mn": 1e6},
    {"rad": 1.0, "mrad": 1e-3, "deg": pi / 180.0},
    {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0},
    {"strain": 1.0, "millistrain": 1e-3, "microstrain": 1e-6},
    {"pa": 1.0, "kpa": 1e3, "mpa": 1e6, "gpa": 1e9},
    {"b": 1.0, "bytes": 1.0, "kb": 1e3, "mb": 1e6, "gb": 1e9},
)
"""Each for one quantity; forces are seldom measured in millinewtons, so that mn is a meganewton."""


def in_other_units(name: str) -> Iterator[tuple[str, float]]:
    """Yield the names of the same quantity in other units, and how many of those units one of `name` is.

    `load_kN` yields `load_n` with 1000, and so on; a name without a known unit yields nothing.
    """
    stem, _, unit = name.rpartition("_")
    for units in _UNITS:
        if stem and unit.lower() in units:
            own = units[unit.lower()]
            yield from (
                (f"{stem}_{other}", own / size) for other, size in units.items() if other != unit.lower()
            )
