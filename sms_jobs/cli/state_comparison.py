"""`sms data compare-states`: displacement at every state against a calculation or another campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sms_jobs import bootstrap
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, search
from sms_jobs.cli import output, writing
from sms_jobs.cli.field_comparison import How, difference_of
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.state_differences import StateDifference, draw_states, written_table
from sms_jobs.records.campaign import LoadState, Subject
from sms_jobs.records.recording import as_recorded

_STATE = "{state}"


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
        str | None, typer.Option(help="Displacement in the mesh files; the first with three components.")
    ] = None,
    scale_mm: Annotated[float, typer.Option(help="Length of the mesh files' unit in mm.", min=1e-9)] = 1.0,
    align: Annotated[
        bool, typer.Option("--align", help="First lay the other shape on this one: they have two frames.")
    ] = False,
    free: Annotated[
        bool, typer.Option("--free-of-motion", help="Leave out the rigid motion that they differ by.")
    ] = False,
    within_mm: Annotated[
        float, typer.Option(help="Points with nothing of the other within this are left out, mm.", min=0.0)
    ] = 5.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .csv for numbers, .png for maps and rms."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Subtract another displacement from the merged one at every state: maps, and rms over the states.

    Example: sms data compare-states hat --with 'model/{state}.vtu' --free-of-motion --out states.png
    """
    if out is not None:
        writing.check_new_file(out, force, (".csv", ".png"))
    if kind not in ("merge", "combine"):
        raise InvalidInput(f"--kind cannot be '{kind}'; choose merge or combine")
    how = How(field, scale_mm, align, free, within_mm)
    with bootstrap.services(home) as services:
        found = [
            _of_state(services, state, mine, theirs, how)
            for state, mine, theirs in _pairs(services, campaign, other, kind)
        ]
    if out is not None:
        title = f"{campaign} minus {other}"
        content = draw_states(found, title) if out.suffix == ".png" else written_table(found)
        writing.write_file(out, content, force)
        output.say(f"wrote {out}")
    if as_json:
        output.print_json_list([one.named() for one in found])
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
    rows = [[_short(cell) for cell in one.row()] for one in found]
    output.print_table(columns, rows, empty="")


def _pairs(services: Services, campaign: str, other: str, kind: str) -> list[tuple[LoadState, str, str]]:
    """Return the states that have both displacements: number of the file, and number or file of the other."""
    pairs: list[tuple[LoadState, str, str]] = []
    with services.catalogue.reading() as session:
        states = campaigns.definition(campaigns.campaign_row(session, campaign)).states
        if _STATE not in other:
            campaigns.campaign_id(session, other)
        for state in states[1:]:
            mine = campaigns.newest_file(session, kind, Subject(campaign, state.label), DATASET_MEDIA_TYPE)
            if _STATE in other:
                file = Path(other.replace(_STATE, state.label))
                theirs = str(file) if file.is_file() else None
            else:
                number = campaigns.newest_file(session, kind, Subject(other, state.label), DATASET_MEDIA_TYPE)
                theirs = None if number is None else str(number)
            if mine is not None and theirs is not None:
                held = as_recorded(state, search.readings(session, mine))
                pairs.append((held, str(mine), theirs))
    if not pairs:
        raise NotFound(
            f"no state of {campaign} has both a {kind} and a displacement in {other}; submit the pipeline of "
            "the campaign, and look at the names of the files"
        )
    return pairs


def _of_state(services: Services, state: LoadState, mine: str, theirs: str, how: How) -> StateDifference:
    found = difference_of(services, mine, theirs, how)
    return StateDifference(
        state.label,
        state.known_load_n,
        state.known_displacement_mm,
        found.points[found.known],
        np.linalg.norm(found.difference[found.known], axis=1),
        float(found.facts()["stated_sigma_mm"]),
    )


def _short(value: Any) -> str:
    if value is None:
        return "-"
    return (
        f"{value:.4g}"
        if isinstance(value, float) and not value.is_integer()
        else str(value).removesuffix(".0")
    )
