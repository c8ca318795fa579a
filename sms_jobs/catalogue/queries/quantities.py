"""Names with a unit at their end, and what to multiply with to ask in another unit."""

from __future__ import annotations

from collections.abc import Iterator

from sms_jobs.records.units import FAMILIES

_IN_NAMES = tuple({unit.lower(): size for unit, size in family.items()} for family in FAMILIES)
"""Names may be written in small letters; forces are seldom in millinewtons, so that mn is a meganewton."""
UNITS = tuple(unit for family in FAMILIES for unit in family)
"""All units that a number may have."""


def in_other_units(name: str) -> Iterator[tuple[str, float]]:
    """Yield the names of the same quantity in other units, and how many of those units one of `name` is.

    `load_kN` yields `load_n` with 1000, and so on; a name without a known unit yields nothing.
    """
    stem, _, unit = name.rpartition("_")
    for units in _IN_NAMES:
        if stem and unit.lower() in units:
            own = units[unit.lower()]
            yield from (
                (f"{stem}_{other}", own / size) for other, size in units.items() if other != unit.lower()
            )


def without_unit(name: str) -> tuple[str, tuple[str, ...]]:
    """Return a name without the unit at its end, and the units of its quantity; none where it has no unit."""
    stem, _, unit = name.rpartition("_")
    for units in FAMILIES:
        if stem and unit.lower() in (one.lower() for one in units):
            return stem, tuple(units)
    return name, ()


def size_in(unit: str, name: str) -> float | None:
    """Return how many of the unit at the end of a name one of `unit` is, None where they are not alike."""
    _, _, own = name.rpartition("_")
    for units, lower in zip(FAMILIES, _IN_NAMES, strict=True):
        if unit in units and own.lower() in lower:
            return units[unit] / lower[own.lower()]
    return None
