"""`sms data compare` and `compare-states`: displacement against calculations and other measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.app.fields import state_comparison
from sms_jobs.app.fields.field_comparison import ComparisonOptions, Difference, difference_of
from sms_jobs.app.fields.state_comparison import StateDifferences
from sms_jobs.cli import output
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json

Align: TypeAlias = Annotated[
    bool, typer.Option("--align", help="First lay the other shape on this one: they have two frames.")
]
FreeOfMotion: TypeAlias = Annotated[
    bool, typer.Option("--free-of-motion", help="Leave out the rigid motion that they differ by.")
]
WithinMm: TypeAlias = Annotated[
    float, typer.Option(help="Points with nothing of the other within this are left out, mm.", min=0.0)
]


def compare(
    file: Annotated[
        str, typer.Argument(help="Number or archive path of a merged or combined result of a state.")
    ],
    other: Annotated[
        str,
        typer.Option(
            "--with", help="Mesh file with a displacement at its nodes, or number of a merged result."
        ),
    ],
    field: Annotated[
        str | None, typer.Option(help="Displacement in the mesh file, if it has several vectors.")
    ] = None,
    scale_mm: Annotated[float, typer.Option(help="Length of the mesh file's unit in mm.", min=1e-9)] = 1.0,
    align: Align = False,
    free: FreeOfMotion = False,
    within_mm: WithinMm = 5.0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="File to write: .csv for numbers, .png for maps.")
    ] = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Subtract another displacement from a merged one: measured minus other, at the measured points.

    Example: sms data compare 42 --with panel.vtu --field U --scale-mm 1000 --free-of-motion --out diff.png
    """
    _check(out, force)
    how = ComparisonOptions(field, scale_mm, align, free, within_mm)
    with bootstrap.services(home) as services:
        found = difference_of(services, file, other, how)
    facts = found.facts()
    _write(found, f"file {file} minus {other}", out, force)
    if as_json:
        output.print_json({"file": file, "other": other} | facts)
        return
    output.print_facts({k.replace("_mm", " [mm]").replace("_", " "): _number(v) for k, v in facts.items()})


def compare_states(
    campaign: Annotated[str, typer.Argument(help="Name of the campaign whose merged results are compared.")],
    other: Annotated[
        str,
        typer.Option(
            "--with",
            help="Mesh files with a displacement at their nodes, '{state}' in their name for its label; "
            "or the name of another campaign whose states have these labels.",
        ),
    ],
    kind: Annotated[str, typer.Option(help="What is compared: merge, or combine.")] = "merge",
    field: Annotated[
        str | None, typer.Option(help="Displacement in the mesh files, if they have several vectors.")
    ] = None,
    scale_mm: Annotated[float, typer.Option(help="Length of the mesh files' unit in mm.", min=1e-9)] = 1.0,
    align: Align = False,
    free: FreeOfMotion = False,
    within_mm: WithinMm = 5.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .csv for numbers, .png for maps and rms."),
    ] = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Subtract another displacement from the merged one at every state: maps, and rms over the states.

    Example: sms data compare-states hat --with 'model/{state}.vtu' --free-of-motion --out states.png
    """
    _check(out, force)
    how = ComparisonOptions(field, scale_mm, align, free, within_mm)
    with bootstrap.services(home) as services:
        found = state_comparison.compare_states(services, campaign, other, kind, how)
    _write(found, f"{campaign} minus {other}", out, force)
    if as_json:
        output.print_json_list([one.named() for one in found.states])
        return
    columns = [
        "state",
        "load [N]",
        "applied [mm]",
        "points",
        "rms [mm]",
        "of the best 95 %",
        "largest",
        "stated",
    ]
    rows = [[_cell(cell) for cell in one.row()] for one in found.states]
    output.print_table(columns, rows, empty="")


def _check(out: Path | None, force: bool) -> None:
    """Raise for a file that could not be written when everything is compared."""
    if out is not None:
        writing.check_new_file(out, force, (".csv", ".png"))


def _write(found: Difference | StateDifferences, title: str, out: Path | None, force: bool) -> None:
    """Write what was compared, as maps or as numbers, where that is asked for."""
    if out is not None:
        content = found.drawn(title) if out.suffix == ".png" else found.table()
        writing.write_file(out, content, force)
        output.say(f"wrote {out}")


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return (
        f"{value:.4g}"
        if isinstance(value, float) and not value.is_integer()
        else str(value).removesuffix(".0")
    )
