"""How the command line speaks: the answer alone on stdout, everything else on stderr."""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from collections.abc import Iterable, Sequence
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sms_jobs.records.plain import SCHEMA, plain
from sms_jobs.records.texts import harmless

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Home = Annotated[
    Path | None,
    typer.Option(
        "--home",
        help="Folder of catalogue and archive; $SMS_HOME if not given, or ~/sms-home.",
        show_default=False,
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]

_MOST_LEFT_OUT = 20
_AS_WIDE_AS_IT_IS = 10_000
_NARROWEST = 20
"""Some terminals and schedulers say that they have 0 columns, in which nothing can be shown."""


def _width() -> int | None:
    """Return the width of answers: where they are no terminal's, nothing has to be folded for one."""
    stated = os.environ.get("COLUMNS", "")
    if stated.isdecimal():
        return int(stated) if int(stated) >= _NARROWEST else _AS_WIDE_AS_IT_IS
    return None if sys.stdout.isatty() else _AS_WIDE_AS_IT_IS


def answer() -> Console:
    """Return what tables and trees are printed on.

    It takes nothing in a text for an instruction: names are given by people, and files by strangers.
    """
    from rich.console import Console

    return Console(soft_wrap=False, highlight=False, markup=False, emoji=False, width=_width())


_LONGEST_REFUSAL = 2_000
_ESCAPED = re.compile("[\x7f-\x9f\ud800-\udfff\u2028\u2029\u202a-\u202e\u2066-\u2069]")


_PARAMETER = re.compile("`([a-z][a-z_]*)`")
"""How messages of use cases name a parameter; the command line calls it by its option."""


def with_options(text: str) -> str:
    """Return a message of a use case with the options of parameters in place of their names."""
    return _PARAMETER.sub(lambda found: "--" + found[1].replace("_", "-"), text)


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object on one line, with its schema version."""
    print_line({"schema": SCHEMA} | value)


def print_json_list(values: Iterable[Any]) -> None:
    """Print a JSON list; `[]` when there is nothing."""
    print_line([plain(v) for v in values])


def print_line(value: Any) -> None:
    """Print one JSON value on one line, at once."""
    line = json.dumps(plain(value), ensure_ascii=False)
    sys.stdout.write(_ESCAPED.sub(lambda found: f"\\u{ord(found[0]):04x}", line) + "\n")
    sys.stdout.flush()


def print_text(text: str) -> None:
    """Print a text as it is, line by line: a plan, a log, a table for another program."""
    sys.stdout.write(harmless(text))


def print_sentence(text: str) -> None:
    """Print one line of an answer that is no table."""
    typer.echo(harmless(text))


def print_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], *, empty: str) -> None:
    """Print a table that fits the terminal, or say on stderr that there is nothing."""
    texts = [[shown(cell) for cell in row] for row in rows]
    if texts:
        answer().print(table_of(columns, texts))
    else:
        say(empty)


def table_of(columns: Sequence[str], texts: Sequence[Sequence[str]]) -> Table:
    """Return a table that fits the terminal, of which nothing is cut off."""
    from sms_jobs.cli.tables import fitted

    return fitted([shown(column) for column in columns], texts, answer().width)


def print_facts(facts: dict[str, Any]) -> None:
    """Print names and values, one a line."""
    width = max(map(len, facts))
    for name, value in facts.items():
        # Not folded: paths and hashes are copied from here.
        typer.echo(f"{_styled(harmless(f'{name:<{width}}'), bold=True)}  {shown(value)}")


def say(text: str) -> None:
    """Tell the person something that is not the answer."""
    typer.echo(harmless(with_options(text)), err=True)


def say_left_out(what: Sequence[str]) -> None:
    """Tell the person what of a table is left out and why, as much as fits a screen."""
    for text in what[:_MOST_LEFT_OUT]:
        say(f"left out: {text}")
    if len(what) > _MOST_LEFT_OUT:
        say(f"left out: {len(what) - _MOST_LEFT_OUT} more; --json lists all")


def say_error(text: str) -> None:
    """Tell the person what is refused; what they gave stands in it, and is cut where it is endless."""
    text = with_options(text)
    if len(text) > _LONGEST_REFUSAL:
        half = _LONGEST_REFUSAL // 2
        text = f"{text[:half]} ... ({len(text)} letters) ... {text[-half:]}"
    typer.echo(f"{_styled('error:', fg='red')} {harmless(text)}", err=True)


def _styled(text: str, **style: Any) -> str:
    """Return a text in its style, which only a terminal is given."""
    return text if os.environ.get("NO_COLOR") else typer.style(text, **style)


def log_to_stderr() -> None:
    """Let a service tell on stderr what it does; libraries speak up only when something is wrong."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Formatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.getLogger("sms_jobs").setLevel(logging.INFO)


class _Formatter(logging.Formatter):
    """Formats what a service tells so that it cannot steer a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        return harmless(super().format(record))


def shown(value: Any) -> str:
    """Return a value as people read it: local time, short numbers, a dash for nothing."""
    if value is None or value == "":
        return "-"
    if isinstance(value, Enum):
        return str(value.value)
    if isinstance(value, datetime):
        return value.astimezone().strftime("%Y-%m-%d %H:%M:%S")
    if isinstance(value, float):
        # 20 kN in N, not 2e+04.
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"
    return harmless(str(value))


def duration(seconds: float) -> str:
    """Return a time span as people read it: two units at most."""
    whole = round(seconds)
    if seconds < 10.0:
        return f"{seconds:.1f} s"
    if whole < 100:
        return f"{whole} s"
    minutes = round(seconds / 60.0)
    if minutes < 100:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min"
    days, hours = divmod(round(seconds / 3600.0), 24)
    return f"{days} d {hours} h"


def clock(at: datetime, now: datetime) -> str:
    """Return a local time, with its day where that is not today's."""
    local, today = at.astimezone(), now.astimezone().date()
    return local.strftime("%H:%M" if local.date() == today else "%Y-%m-%d %H:%M")
