"""Names with a unit at their end, and what to multiply with to ask in another unit."""

from __future__ import annotations

from collections.abc import Iterator

from sms_jobs.records.units import FAMILIES

_UNITS = tuple({unit.lower(): size for unit, size in family.items()} for family in FAMILIES)
"""Names may be written in small letters; forces are seldom in millinewtons, so that mn is a meganewton."""


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
