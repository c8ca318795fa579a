"""`sms bench` and `sms study`: figures and studies that anyone can run again."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterable, Sequence
from math import isnan
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from sms_jobs.bench.compilation import compile_seconds
from sms_jobs.bench.figures import Figure, Run, machine
from sms_jobs.bench.groups import all_groups, group_named
from sms_jobs.bench.peers import ONE_THREAD
from sms_jobs.bench.studies import all_studies, study_named
from sms_jobs.bench.study import outputs, write
from sms_jobs.cli import output
from sms_jobs.cli.demo import Size
from sms_jobs.cli.output import Json
from sms_jobs.discovery import told_names

_WIDE = 240


def _group_names(incomplete: str) -> list[str]:
    return [name for name in told_names("sms_jobs.bench.groups", "GROUP") if name.startswith(incomplete)]


def _study_names(incomplete: str) -> list[str]:
    names = ["list", *told_names("sms_jobs.bench.studies", "STUDY")]
    return [name for name in names if name.startswith(incomplete)]


def bench(
    groups: Annotated[
        list[str] | None,
        typer.Argument(help="Groups of figures; all if none is given.", autocompletion=_group_names),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Leave out or shrink what takes long, and say so.")
    ] = False,
    threads: Annotated[
        int, typer.Option(min=1, help="Threads of what is timed by the clock; rates always use one.")
    ] = 2,
    as_json: Json = False,
) -> None:
    """Measure speed and accuracy on this machine, and compare them with the project's targets.

    Rates are per CPU-second of one thread; compilation is not in them and is stated by itself.

    Example: sms bench --json phase fdr
    """
    os.environ.update(ONE_THREAD)  # before a group loads them
    chosen = [group_named(name) for name in dict.fromkeys(groups or sorted(all_groups()))]
    about = machine()
    started = time.monotonic()

    def say(text: str) -> None:
        output.say(f"[{time.monotonic() - started:5.1f} s] {text}")

    names = [group.name for group in chosen]
    for group in chosen:
        if missing := group.lacks():  # before minutes of compiling
            say(f"{group.name}: figures will be left out: {missing}")
    say(f"compiling the kernels of {' and '.join(names)}")
    compiled = compile_seconds(names)
    found: dict[str, Figure] = {}
    conditions: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="sms-bench-") as folder:
        run = Run(quick, say, threads, Path(folder))
        for group in chosen:
            say(f"{group.name}: {group.summary}")
            for one in group.measure(run):
                if isinstance(one, Figure):
                    found[f"{group.name}.{one.name}"] = one
                else:
                    conditions[f"{group.name}.{one.topic}"] = one.text
    if as_json:
        output.print_json(
            {
                "machine": about,
                "results": {name: _known(figure.value) for name, figure in found.items()},
                "compile_s": compiled,
                "conditions": conditions,
                "quick": quick,
            }
        )
        return
    rows = [(name, f.value, f.unit, _target(f), _verdict(f)) for name, f in found.items()]
    _print_wide(("figure", "value", "unit", "target", "met"), rows)
    output.print_facts({"compilation, s": compiled} | conditions)


def _print_wide(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table whose names are not cut off, however narrow the terminal is."""
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, no_wrap=True)
    for row in rows:
        table.add_row(*(output.shown(cell) for cell in row))
    wide = Console(width=max(output.answer().width, _WIDE), highlight=False, markup=False, emoji=False)
    wide.print(table, soft_wrap=True)


def _known(value: float | None) -> float | None:
    """Return None for what is not a number: JSON knows no NaN."""
    return None if value is None or isnan(value) else value


def _target(figure: Figure) -> str:
    return "" if figure.target is None else f"{figure.sense} {figure.target:g}"


def _verdict(figure: Figure) -> str:
    return {None: "", True: "yes", False: "no"}[figure.met]


def study(
    name: Annotated[str, typer.Argument(help="Name of a study, or 'list'.", autocompletion=_study_names)],
    out: Annotated[Path, typer.Option(help="Folder for the picture and the numbers.")] = Path("sms-study"),
    size: Annotated[
        Size | None, typer.Option(help="Cameras of 512 (small) or 1024 (full) px, where a study has both.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Run a study again: its table on the screen, its picture and numbers in a folder.

    The table is written too, as CSV. Studies of the thesis's tests say besides what the thesis has.

    Example: sms study table-6 --out /tmp/studies; sms study rigid-motion --size full --out /tmp/studies
    """
    if name == "list":
        if as_json:
            output.print_json({"studies": {s.name: s.summary for s in all_studies().values()}})
            return
        rows = [(s.name, s.summary) for s in all_studies().values()]
        output.print_table(("study", "what it shows"), rows, empty="there are no studies")
        return
    chosen = study_named(name)
    answer = chosen.of_size(size.value if size else None)
    outputs(chosen, out)  # before minutes of work
    outcome = answer(output.say)
    files = write(outcome, chosen, out)
    if as_json:
        about = {"study": name, "machine": machine(), "files": [str(f) for f in files]}
        output.print_json(about | outcome.as_json())
        return
    _print_wide(outcome.table.columns, outcome.table.known())
    if outcome.judged:
        from sms_jobs.bench.published import COLUMNS

        _print_wide(COLUMNS, [one.row() for one in outcome.judged])
    output.print_facts(dict(outcome.table.remarks))
    output.say(f"wrote {', '.join(map(str, files))}")
