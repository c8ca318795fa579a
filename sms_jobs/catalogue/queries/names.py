"""Finds what the names of a query mean: in full, in another unit, or by their beginning."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any, Literal, NoReturn, TypeAlias

from sqlalchemy import ColumnElement, Select

from sms_jobs.catalogue.queries.language import A_COLUMN, Between, Name, Test, refuse, values_of
from sms_jobs.catalogue.queries.quantities import UNITS, in_other_units, size_in, without_unit

Type: TypeAlias = Literal["number", "text", "time", "prefix", "campaign", "calibration", "parameter"]

_LONG = {"max": "maximum", "min": "minimum", "med": "median", "avg": "mean"}
_LISTED = 12
"""So many names are listed where one is unknown; of more the nearest."""
_NEAREST = 3
_MORE = {
    "": "docs/query.md has the names, and 'sms data show FILE' those of what a result knows",
    "param": "'sms job kinds' has them",
    "statistic": "'sms data show FILE' has those of a result",
}


@dataclass(frozen=True)
class Source:
    """A selection of the numbers of files, and the column of it that an index is on."""

    files: Select[int]
    indexed: ColumnElement[Any]


@dataclass(frozen=True)
class Field:
    """Something that can be asked about a file or a state.

    Attributes
    ----------
    name
        As it was asked for.
    type
        What it is compared with; a prefix is a text of which the beginning is enough.
    column
        Its value for a row of `file`, or of `load_state`.
    factor
        A value in the unit of `name` times this is one in the unit of the column.
    sources
        Select the numbers of files by indexes, which together find every file; empty where there is none.
    of_state
        A column of `load_state` that has an index and is the value of every file of its state.
    stored
        The name under which it is kept, with the unit of the column at its end, or the name of a parameter.
    needs_unit
        Whether `name` leaves the unit open, so that a value has to say it.
    """

    name: str
    type: Type
    column: ColumnElement[Any]
    factor: float = 1.0
    sources: tuple[Source, ...] = ()
    of_state: ColumnElement[Any] | None = None
    stored: str = ""
    needs_unit: bool = False


class Resolver:
    """Finds fields by name, and refuses what is none with what there is instead.

    Parameters
    ----------
    look
        Returns the field of a name, or the names that it may be the beginning of.
    names
        Returns all names, or those behind `statistic.` and the like.
    """

    def __init__(
        self, look: Callable[[str], Field | list[str]], names: Callable[[str], Sequence[str]]
    ) -> None:
        self._look = look
        self._names = names
        self._found: dict[str, Field | list[str]] = {}

    def field(self, name: Name, text: str) -> Field:
        """Return what a name of a query means.

        Raises
        ------
        InvalidInput
            Nothing is called so, or it leaves the unit open; the message points at the place in `text` and
            names what there is.
        """
        found = self._field(name, text)
        if found.needs_unit:
            stem, units = without_unit(found.stored)
            also = " or ".join(f"{stem}_{unit}" for unit in units)
            how = f"write {also}" if name.at == A_COLUMN else f"write it behind the number, or {also}"
            refuse(text, name.at, f"'{name.text}' needs a unit: {how}")
        return found

    def tested(self, part: Test, text: str) -> Field:
        """Return what a test compares, in the unit of its values; raises as `field` does.

        `load > 50 kN` is `load_kN > 50`.
        """
        written = [value for value in values_of(part) if value.unit]
        if not written:
            return self.field(part.name, text)
        first, unit = written[0], written[0].unit
        bare = [value for value in values_of(part) if not value.unit]
        # The lower end of a range may leave its unit to the upper: between 50 and 60 kN.
        if any(value.unit != unit for value in written) or (bare and not isinstance(part, Between)):
            refuse(text, part.name.at, f"the values of '{part.name.text}' have several units; write one")
        if unit not in UNITS:
            refuse(text, first.at, f"'{unit}' is no unit that is known; there are {listed(UNITS)}")
        asked = self._known(f"{part.name.text}_{unit}")
        if isinstance(asked, Field):
            return asked
        found = self._field(part.name, text)
        size = size_in(unit, found.stored)
        if size is None:
            _, units = without_unit(found.stored)
            has = f"is in {listed(units)}" if units else "has no unit that is known"
            refuse(text, first.at, f"'{part.name.text}' {has}, and '{first.text} {unit}' is another quantity")
        stem, _ = without_unit(part.name.text)
        return replace(found, name=f"{stem}_{unit}", factor=size, needs_unit=False)

    def _known(self, name: str) -> Field | list[str]:
        if name not in self._found:
            self._found[name] = self._look(name)
        return self._found[name]

    def _field(self, name: Name, text: str) -> Field:
        found = self._known(name.text)
        return found if isinstance(found, Field) else self._refuse(name, text, found)

    def _refuse(self, name: Name, text: str, found: list[str]) -> NoReturn:
        if found:
            refuse(text, name.at, f"'{name.text}' may mean {listed(found)}; write which")
        space, dot, _ = name.text.partition(".")
        names = self._names(space.lower() if dot else "")
        near = get_close_matches(name.text.lower(), [k.lower() for k in names], n=_NEAREST, cutoff=0.5)
        alike = [f"'{next(k for k in names if k.lower() == one)}'" for one in near]
        hint = f"; did you mean {' or '.join(alike)}" if alike else ""
        there = f"there are {listed(names)}" if names else "there are none of that sort yet"
        if len(names) > _LISTED:
            there = _MORE.get(space.lower() if dot else "", _MORE[""])
        refuse(text, name.at, f"nothing is called '{name.text}'{hint}; {there}")


def built_in(name: str, fields: Iterable[Field]) -> Field | None:
    """Return the one of some fields that is called so, in its own unit, in another, or without one."""
    for field in fields:
        if field.name == name.lower():
            return field
        if field.type != "number":
            continue
        for other, factor in in_other_units(name.lower()):
            if other == field.name:
                return replace(field, name=name, factor=factor)
        if without_unit(field.name)[0] == name.lower():
            return replace(field, name=name, needs_unit=True)
    return None


def stored_name(name: str, stored: Sequence[str], whole: bool = False) -> tuple[str, float] | list[str]:
    """Return the stored name that is meant, and what one of the unit asked for is in that of the stored one.

    That is the one that is called so, in another unit, or the only one that begins so; of several, their
    names. With `whole` a beginning is not enough.
    """
    if name in stored:
        return name, 1.0
    lower = {s.lower(): s for s in stored}
    first, _, rest = name.lower().partition("_")
    long = f"{_LONG[first]}_{rest}" if first in _LONG and rest else name.lower()
    for written in (name.lower(), long):
        if written in lower:
            return lower[written], 1.0
        for other, factor in in_other_units(written):
            if other in lower:
                return lower[other], factor
    if whole:
        return []
    begun = [s for s in stored if s.lower().startswith(f"{long}_")]
    return (begun[0], 1.0) if len(begun) == 1 else begun


def listed(names: Iterable[str]) -> str:
    """Return names with commas between."""
    return ", ".join(names)
