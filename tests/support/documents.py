"""What documents quote: commands, and tables of figures that machines have written."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from math import isnan
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup

from sms_jobs.cli.commands import COMMANDS
from sms_jobs.kinds import all_kinds

_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"`([^`]+)`")
_OURS = re.compile(r"(?:^|(?<!-u)[\s(])(?:[\w./-]*/)?sms (?=[a-z])")
_ENDS = re.compile(r"(?:^|(?<=\s))(?:\||\|\||&&|&|;|>|<|2>)(?=\s|$)|\$\(|(?<=\w)\)|;")
_PROMPTS = re.compile(r"^(?:\$|>) ", re.MULTILINE)
_USAGE = typer.BadParameter.__mro__[1]
SHELLS = ("", "console", "bash", "sh")


def quoted(text: str) -> Iterator[str]:
    """Yield the commands of ours that a Markdown text quotes, in blocks and in lines, each without `sms`."""
    for language, block in _FENCED.findall(text):
        if language in SHELLS:
            joined = re.sub(r"\\\n(?:> )?\s*", " ", _PROMPTS.sub("", block))
            for line in joined.splitlines():
                yield from _of_line(line)
    for span in _INLINE.findall(_FENCED.sub("", text)):
        yield from _of_line(" ".join(span.split()))


def _of_line(line: str) -> Iterator[str]:
    line = re.sub(r"(?:^|\s)#.*", "", line)
    for found in _OURS.finditer(line):
        yield _first(line[found.end() :])


def _first(rest: str) -> str:
    """Return a line up to where the shell ends a command, outside of quotation marks."""
    quote, place = "", 0
    while place < len(rest):
        letter = rest[place]
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif _ENDS.match(rest, place):
            return rest[:place]
        place += 1
    # A mark that is not opened here was opened before the command: sh -c '... sms doctor'.
    return rest.rstrip(quote) if quote else rest


def complaint(command: str) -> str:
    """Return what is wrong with a quoted command: there is no such command or option; empty if nothing."""
    words = [w for w in shlex.split(command) if not set(w) <= set(".")]
    if words[0] not in COMMANDS:
        return f"there is no command '{words[0]}'"
    found = _loaded(words[0])
    path, rest = [words[0]], words[1:]
    while isinstance(found, TyperGroup):
        if not rest or rest[0].startswith("-"):
            return "" if set(rest) <= {"--help"} else f"{' '.join(path)} has no options"
        if rest[0] not in found.commands and (otherwise := getattr(found, "otherwise", "")):
            rest = [otherwise, *rest]
        if rest[0] not in found.commands:
            return f"there is no command '{' '.join([*path, rest[0]])}'"
        path, found, rest = [*path, rest[0]], found.commands[rest[0]], rest[1:]
    return _parsed(path, found, rest)


@cache
def _loaded(name: str) -> Any:
    return COMMANDS[name].load(name)


def _parsed(path: list[str], command: Any, words: list[str]) -> str:
    if "--help" in words:
        return ""
    context = typer.Context(command, info_name=path[-1], **command.context_settings)
    try:
        options, left, _ = command.make_parser(context).parse_args(list(words))
    except _USAGE as error:
        # An option that is named alone stands for itself.
        return "" if "requires an argument" in str(error) else str(error)
    if left:
        return f"'{' '.join(path)}' does not take '{left[0]}'"
    if path == ["job", "submit"]:
        return _not_of_kinds(options["kind"] or ())
    return ""


def _not_of_kinds(words: Sequence[str]) -> str:
    names = [w for w in words if not w.startswith("--")]
    kinds = [kind for name, kind in all_kinds().items() if name in names]
    for word in words:
        option = word.removeprefix("--").partition("=")[0].replace("-", "_")
        if word.startswith("--") and not any(option in kind.parameters.model_fields for kind in kinds):
            return f"no kind of 'job submit {' '.join(names)}' has the parameter {word}"
    return ""


@dataclass(frozen=True)
class FigureTable:
    """A table of a document whose figures stand in a file that a study has written.

    Attributes
    ----------
    file
        That has them.
    where
        Which of its rows are meant: the value of a column, by name.
    columns
        What each column of the table is called in the file; several with semicolons between, empty for words.
    rows
        Cells of the document.
    """

    file: str
    where: dict[str, float]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


_TABLE = re.compile(
    r"^<!-- (\S+\.json)(?:, where ([^\n]*?) = ([\d.]+))?:\n(.*?) -->\n+((?:\|.*\n)+)", re.MULTILINE
)
_NUMBER = re.compile(r"[-+]?\d[\d ]*(?:\.\d+)?")


def figure_tables(text: str) -> list[FigureTable]:
    """Return the tables of a Markdown text that say in a comment before them what they are from."""
    return [
        FigureTable(
            file,
            {name: float(value)} if name else {},
            _cells(columns),
            tuple(_cells(line) for line in table.splitlines()[2:]),
        )
        for file, name, value, columns, table in _TABLE.findall(text)
    ]


def _cells(line: str) -> tuple[str, ...]:
    parts = re.split(r"(?<!\\)\|", line.strip())
    return tuple(part.strip() for part in parts[1:-1])


def disagreements(table: FigureTable, folder: Path) -> list[str]:
    """Return what a table says that its file does not, rounded as the table rounds it.

    A row of the file is found by the first number of the table's; where that is a word, rows are in order.
    """
    stored: list[dict[str, Any]] = json.loads((folder / table.file).read_text(encoding="utf-8"))["rows"]
    chosen = [row for row in stored if all(row[name] == value for name, value in table.where.items())]
    unknown = [c for cell in table.columns for c in _names(cell) if c not in chosen[0]]
    if unknown:
        return [f"{table.file} has no column '{unknown[0]}'; it has {', '.join(chosen[0])}"]
    found = []
    for place, cells in enumerate(table.rows):
        key = table.columns[0]
        rows = chosen[place : place + 1] if not key else [r for r in chosen if _says(cells[0], [r[key]])]
        if not any(_agrees(table.columns, cells, row) for row in rows):
            found.append(f"{table.file}: no row says {' | '.join(cells)}; {rows[:1]}")
    return found


def _names(cell: str) -> list[str]:
    return [name.strip() for name in cell.split(";") if name.strip()]


def _agrees(columns: Sequence[str], cells: Sequence[str], row: dict[str, Any]) -> bool:
    return all(
        _says(cell, [row[name] for name in _names(column)])
        for column, cell in zip(columns, cells, strict=True)
    )


def _says(cell: str, values: Sequence[float | None]) -> bool:
    """Whether the numbers of a cell are those values, rounded; per cent are parts or per cent."""
    told = _NUMBER.findall(cell)
    if not values or not told:
        return not values or any(v is None or isnan(v) for v in values)
    factors = (1.0, 100.0) if "%" in cell else (1.0,)
    return len(told) == len(values) and all(
        value is not None and any(_rounded(text.replace(" ", ""), factor * value) for factor in factors)
        for text, value in zip(told, values, strict=True)
    )


def _rounded(text: str, value: float) -> bool:
    _, _, decimals = text.partition(".")
    # Half of the last digit, and what a decimal number cannot hold of it.
    return abs(float(text) - value) <= 0.5 * 10.0 ** -len(decimals) * (1.0 + 1e-9) + 1e-12
