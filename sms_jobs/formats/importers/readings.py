"""Tables of readings: CSV whose rows belong to states, by label or by time.

A row is used as a whole, or left out and reported; a cell that holds no number is an error unless it is
empty or NaN, which is nothing measured.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta, tzinfo
from math import isfinite, isnan
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.csv_tables import csv_cells
from sms_jobs.formats.importers.folders import printable
from sms_jobs.records.times import checked_time

LARGEST_BYTES = 64 << 20
MOST_ROWS = 1_000_000
MOST_COLUMNS = 2_000

_WITH_UNIT = re.compile(r"(?P<name>[^\[\](){}]+?)\s*(?:\[(?P<unit>[^\]]*)\]|\((?P<round>[^)]*)\))?\s*")
_CHANNEL = re.compile(r"[A-Za-z][A-Za-z0-9._-]{0,63}")
_UNIT = re.compile(r"[A-Za-z0-9]{1,12}")
_STRAINS = {
    "1": 1.0, "strain": 1.0, "m/m": 1.0, "mm/m": 1e-3, "%": 1e-2, "millistrain": 1e-3, "permille": 1e-3,
    "um/m": 1e-6, "µm/m": 1e-6, "μm/m": 1e-6, "microstrain": 1e-6, "ue": 1e-6, "ustrain": 1e-6,
}  # fmt: skip
_FORCES = {"N": 1.0, "kN": 1e3, "MN": 1e6, "mN": 1e-3}
_LENGTHS = {"um": 1e-3, "µm": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3}
_ROUND = _STRAINS.keys() - {"1", "strain"}
"""Strains that round brackets can say: in them 1 is the number of a gauge, and strain what it measures."""
_BESIDE_A_NAME = frozenset("%‰/µμ")
"""What units have and channels do not: a header with it outside of brackets may say a unit by itself."""
_NOTHING = {"", "nan", "na", "n/a", "-", "null", "none", "--"}
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")


@dataclass(frozen=True)
class Column:
    """What a column of a table becomes.

    Attributes
    ----------
    header
        In the file.
    target
        load_n, displacement_mm, or the name of a channel.
    factor
        By which its values are multiplied.
    """

    header: str
    target: str
    factor: float

    def scaled(self, value: float) -> float:
        """Return a value in the unit that is stored; a division keeps 571.4 um/m at 0.0005714."""
        return value * self.factor if self.factor >= 1.0 else value / round(1.0 / self.factor)

    @classmethod
    def parse(cls, header: str, text: str, default_unit: str = "") -> Column:
        """Read `channel[unit]`; raise `InvalidInput` where the unit does not fit.

        Forces and displacements of the state are `load[kN]` and `displacement[um]`; strains become ratios;
        any other unit becomes the end of the channel's name, by which it can be asked for in others. Where
        the text says no unit and one would be assumed, that of the header comes first.
        """
        found = _WITH_UNIT.fullmatch(text)
        name = "" if found is None else found["name"].strip()
        unit = "" if found is None else (found["unit"] or found["round"] or "").strip()
        if not unit and (default_unit or name in ("load", "load_n", "displacement", "displacement_mm")):
            unit = _unit_of(header, default_unit)
        if not _CHANNEL.fullmatch(name):
            raise InvalidInput(
                f"'{printable(text)}' is no channel for column '{printable(header)}': write a name of "
                "letters, digits, '.', '_' or '-' with its unit behind it, as gauge_1[um/m]"
            )
        for special, target, units in (
            ("load", "load_n", _FORCES),
            ("displacement", "displacement_mm", _LENGTHS),
        ):
            if name in (special, target):
                own = unit or ("" if name == special else "N" if special == "load" else "mm")
                factor = _factor(own, units)
                if factor is None:
                    raise InvalidInput(
                        f"column '{printable(header)}' is {special} in '{printable(own)}': give one of "
                        f"{', '.join(units)}, as {special}[{list(units)[1]}]"
                    )
                return cls(header, target, factor)
        if unit.lower() in _STRAINS:
            return cls(header, name, _STRAINS[unit.lower()])
        if unit in ("°C", "degC"):
            unit = "C"
        if unit and not _UNIT.fullmatch(unit):
            plain = re.sub("[^A-Za-z0-9]", "", unit) or "unit"
            raise InvalidInput(
                f"column '{printable(header)}' has the unit '{printable(unit)}', which cannot end a name: "
                f"map it, as in '{printable(header)}={name}[{plain}]'"
            )
        if unit and not name.lower().endswith(f"_{unit.lower()}"):
            name = f"{name}_{unit}"
        return cls(header, name, 1.0)

    @classmethod
    def named_by(cls, header: str, default_unit: str = "") -> Column:
        """Return what a column becomes by its header alone; raise `InvalidInput` for an unclear unit."""
        stem, bracket, rest = header.partition("[")
        found = _WITH_UNIT.fullmatch(header)
        if found is not None and (found["round"] or "").strip().lower() in _ROUND:
            stem, bracket, rest = found["name"], "[", f"{found['round']}]"
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", stem.strip()).strip("_")
        return cls.parse(header, name.lower() + bracket + rest, default_unit)


def _unit_of(header: str, default: str) -> str:
    """Return the unit in a header's brackets, else the default; refuse a unit that is not in brackets."""
    found = _WITH_UNIT.fullmatch(header)
    said = "" if found is None else (found["unit"] or "").strip()
    in_words = "" if found is None else (found["round"] or "").strip()
    if said or in_words.lower() in _ROUND or _factor(in_words, _FORCES | _LENGTHS) is not None:
        return said or in_words
    if default and _BESIDE_A_NAME & set(header):
        raise InvalidInput(
            f"column '{printable(header)}' may say a unit that is not in brackets: map it with its "
            f"unit, as in '{printable(header)}=gauge_1[{default}]'"
        )
    return default


def _factor(unit: str, units: Mapping[str, float]) -> float | None:
    """Return the factor of a unit: as it is written, or in other letters where those mean one alone."""
    alike = [known for known in units if known.lower() == unit.lower()]
    return units[unit] if unit in units else units[alike[0]] if len(alike) == 1 else None


@dataclass(frozen=True)
class Reading:
    """What is to be entered of a state: its load, displacement or time, and scalar channels by name."""

    state: str
    channels: Mapping[str, float]
    load_n: float | None = None
    displacement_mm: float | None = None
    time: datetime | None = None


@dataclass(frozen=True)
class Table:
    """A file of readings: its header, and rows of text; `lines` are their numbers in the file."""

    source: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    decimal: str
    remarks: tuple[str, ...] = ()

    def column(self, header: str) -> int:
        """Return the place of a column; raise `InvalidInput` where there is none of that name."""
        if header not in self.header:
            raise InvalidInput(
                f"{self.source} has no column '{printable(header)}'; it has {', '.join(self.header[:20])}"
            )
        return self.header.index(header)

    def number(self, row: int, column: int) -> float:
        """Return a cell as a number, NaN for nothing; raise `InvalidInput` for anything else."""
        text = self.rows[row][column].strip()
        if text.lower() in _NOTHING:
            return float("nan")
        try:
            # Beside decimal commas a point parts thousands, for some: 1.234 has two meanings.
            several = self.decimal == "," and "." in text
            value = float("inf" if several else text.replace(",", ".") if self.decimal == "," else text)
        except ValueError:
            value = float("inf")
        if not (isfinite(value) or isnan(value)) or "_" in text:
            raise InvalidInput(
                f"{self.source}, line {self.lines[row]}: '{printable(text[:40])}' in column "
                f"'{self.header[column]}' is no finite number: correct it, or leave the cell empty"
            )
        return value


@dataclass(frozen=True)
class Readings:
    """What a table says about the states, and what was not used, in words."""

    readings: tuple[Reading, ...]
    left_out: tuple[str, ...]
    remarks: tuple[str, ...] = field(default=())


def read_table(path: Path, delimiter: str | None = None, decimal: str | None = None) -> Table:
    """Read a CSV file: comma, semicolon or tab between columns, lines that begin with # left out.

    Raises
    ------
    NotFound
        There is no such file.
    InvalidInput
        It cannot be read, is too large or no text, has no header, one name twice, or rows of other lengths.
    """
    text, remarks = _text(path)
    numbered = [
        (i, line)
        for i, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not numbered:
        raise InvalidInput(f"{path.name} is empty: a header and at least one row are needed")
    mark = delimiter or max("\t;,", key=numbered[0][1].count)
    if len(mark) != 1:
        raise InvalidInput(f"the `delimiter` should be one character, not '{printable(mark)}'")
    if mark in '\r\n"':
        raise InvalidInput(f"the `delimiter` cannot be '{printable(mark)}': give comma, semicolon or tab")
    lines_read = io.StringIO("\n".join(line for _, line in numbered))
    header, *rows = csv_cells(lines_read, path.name, mark)
    names = tuple(name.strip() for name in header)
    if len(names) > MOST_COLUMNS or len(rows) > MOST_ROWS:
        raise InvalidInput(
            f"{path.name} has {len(names)} columns and {len(rows)} rows; read are {MOST_COLUMNS} and "
            f"{MOST_ROWS}: split it"
        )
    twice = sorted({n for n in names if n and names.count(n) > 1})
    if twice:
        raise InvalidInput(f"{path.name} has the column '{printable(twice[0])}' twice: rename one of them")
    if not rows:
        raise InvalidInput(f"{path.name} has a header and no row")
    lines = tuple(i for i, _ in numbered[1:])
    if len(lines) != len(rows):
        raise InvalidInput(f"{path.name} has cells that go over several lines: save it without them")
    for line, row in zip(lines, rows, strict=True):
        if len(row) != len(names):
            raise InvalidInput(
                f"{path.name}, line {line} has {len(row)} cells, but the header has {len(names)}: correct "
                "it, or give another `delimiter`"
            )
    point = decimal or _decimal(rows, mark)
    if point not in (".", ","):
        raise InvalidInput(f"the `decimal` mark should be . or , and not '{printable(point)}'")
    if point == "," and decimal is None:
        remarks.append("numbers are read with a decimal comma")
    return Table(path.name, names, tuple(map(tuple, rows)), lines, point, tuple(remarks))


def _text(path: Path) -> tuple[str, list[str]]:
    try:
        if not path.is_file():
            what = NotFound if not path.exists() else InvalidInput
            raise what(f"there is no file {path}" if not path.exists() else f"{path} is no regular file")
        if path.stat().st_size > LARGEST_BYTES:
            raise InvalidInput(f"{path.name} is larger than the {LARGEST_BYTES >> 20} MiB that are read")
        content = path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from error
    if b"\0" in content:
        raise InvalidInput(f"{path.name} is no CSV text: save it as CSV in UTF-8")
    try:
        return content.decode("utf-8-sig"), []
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace"), ["read as Windows text (cp1252): it is not UTF-8"]


def _decimal(rows: Sequence[Sequence[str]], delimiter: str) -> str:
    if delimiter == ",":
        return "."
    cells = [cell.strip() for row in rows for cell in row]
    commas = any(_DECIMAL_COMMA.fullmatch(c) for c in cells)
    return "," if commas and not any(re.fullmatch(r"[+-]?\d+\.\d+", c) for c in cells) else "."


def zone_named(name: str) -> tzinfo:
    """Return a time zone such as Europe/Berlin; raise `InvalidInput` for an unknown one."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise InvalidInput(
            f"there is no time zone '{printable(name)}': write it like Europe/Berlin or UTC"
        ) from None


def states_by_label(table: Table, column: int, known: Sequence[str]) -> tuple[list[str | None], list[str]]:
    """Return the state of every row by its label, None where there is none, and what was left out."""
    found: list[str | None] = []
    left_out = []
    for line, row in zip(table.lines, table.rows, strict=True):
        label = row[column].strip()
        found.append(label if label in known else None)
        if label not in known:
            left_out.append(f"line {line}: the campaign has no state '{printable(label)}'")
    return found, left_out


def states_by_time(
    table: Table, column: int, times: Mapping[str, datetime], zone: tzinfo | None, within: timedelta
) -> tuple[list[str | None], list[str]]:
    """Return of every row the state that it is the nearest to, if no further than `within`; else None.

    Raises `InvalidInput` for what is no time, and for a time without zone where none is given.
    """
    at = [_time(table, i, column, zone) for i in range(len(table.rows))]
    found: list[str | None] = [None] * len(at)
    left_out = []
    for state, held in times.items():
        nearest = min(range(len(at)), key=lambda i: abs(at[i] - held))
        if abs(at[nearest] - held) > within:
            left_out.append(
                f"state {state}: the nearest row, line {table.lines[nearest]}, is "
                f"{abs(at[nearest] - held).total_seconds():.3g} s away; at most "
                f"{within.total_seconds():g} s are allowed (`within`)"
            )
        elif found[nearest] is not None:
            left_out.append(
                f"state {state}: its row, line {table.lines[nearest]}, is that of {found[nearest]}"
            )
        else:
            found[nearest] = state
            same = [table.lines[i] for i, time in enumerate(at) if time == at[nearest]]
            if len(same) > 1:
                left_out.append(
                    f"state {state}: {len(same)} rows have the time nearest to it, that of line {same[0]} "
                    f"counts and that of line {same[1]} does not"
                )
    return found, left_out


def _time(table: Table, row: int, column: int, zone: tzinfo | None) -> datetime:
    text = table.rows[row][column].strip()
    where = f"{table.source}, line {table.lines[row]}"
    try:
        at = datetime.fromisoformat(text)
    except ValueError:
        raise InvalidInput(
            f"{where}: '{printable(text[:40])}' is no time: write it as 2026-05-04T10:00:00+02:00"
        ) from None
    if at.tzinfo is None:
        if zone is None:
            raise InvalidInput(
                f"{where}: the time {text} has no zone: give `time_zone`, for example Europe/Berlin"
            )
        at = at.replace(tzinfo=zone)
    return checked_time(at, where)


def readings_of(table: Table, states: Sequence[str | None], columns: Sequence[Column]) -> Readings:
    """Return what the rows tell of their states; empty and NaN cells are left out and reported.

    Raises
    ------
    InvalidInput
        A cell is no number, two columns become one channel, or a state has two rows.
    """
    targets = [c.target for c in columns]
    twice = sorted({t for t in targets if targets.count(t) > 1})
    if twice:
        raise InvalidInput(f"two columns become {twice[0]}: map one of them to another channel")
    places = [table.column(c.header) for c in columns]
    seen: dict[str, int] = {}
    readings, left_out = [], []
    for row, state in enumerate(states):
        values = {c.target: c.scaled(table.number(row, p)) for c, p in zip(columns, places, strict=True)}
        if state is None:
            continue
        if state in seen:
            raise InvalidInput(
                f"{table.source} has state {state} twice, in lines {seen[state]} and {table.lines[row]}: "
                "keep one"
            )
        seen[state] = table.lines[row]
        empty = [name for name, value in values.items() if isnan(value)]
        left_out += [f"line {table.lines[row]}: {name} of {state} is empty or NaN" for name in empty]
        kept = {name: value for name, value in values.items() if not isnan(value)}
        load, displacement = kept.pop("load_n", None), kept.pop("displacement_mm", None)
        readings.append(Reading(state, kept, load, displacement))
    return Readings(tuple(readings), tuple(left_out))
