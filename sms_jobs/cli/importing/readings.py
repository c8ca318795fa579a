"""`sms import channels|gauges`: tables of readings become channels of a campaign's states."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import output
from sms_jobs.cli.importing.options import CampaignName
from sms_jobs.cli.importing.outcomes import confirm
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sizes import number_of

if TYPE_CHECKING:
    from sms_jobs.app.importing.readings import Arranged

_FINDINGS = 6

File = Annotated[Path, typer.Argument(help="CSV file with a header.")]
Maps = Annotated[
    list[str] | None,
    typer.Option("--map", help="COLUMN=CHANNEL[UNIT], several times; all columns if not given."),
]
StateColumn = Annotated[str | None, typer.Option("--state-column", help="Column of the states' labels.")]
TimeColumn = Annotated[
    str | None, typer.Option("--time-column", help="Column of times, which find the state nearest.")
]
TimeZone = Annotated[
    str | None, typer.Option("--time-zone", help="Zone of times that have none, as Europe/Berlin.")
]
Within = Annotated[float, typer.Option(help="Seconds that a row may be away from its state.", min=0.0)]
Delimiter = Annotated[str | None, typer.Option(help="Between columns; found if not given.")]
Decimal = Annotated[str | None, typer.Option(help="Decimal mark, . or ,; found if not given.")]
Replace = Annotated[bool, typer.Option("--replace", help="Replace values that states have already.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask whether guessed channels are right.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would change, and change nothing.")]


def _command(unit: str, words: str) -> Callable[..., None]:
    """Return a command that enters a table, whose columns are in `unit` unless they say another."""

    def command(
        file: File,
        campaign: CampaignName,
        maps: Maps = None,
        state_column: StateColumn = None,
        time_column: TimeColumn = None,
        time_zone: TimeZone = None,
        within: Within = 2.0,
        delimiter: Delimiter = None,
        decimal: Decimal = None,
        replace: Replace = False,
        dry_run: DryRun = False,
        yes: Yes = False,
        home: Home = None,
        as_json: Json = False,
    ) -> None:
        from sms_jobs.app.importing.readings import Task, arrange_readings, enter

        task = Task(
            file,
            campaign,
            tuple(maps or ()),
            state_column,
            time_column,
            time_zone,
            timedelta(seconds=within),
            delimiter,
            decimal,
            unit,
            replace,
        )
        with bootstrap.services(home) as services:
            found = arrange_readings(services, task)
            if found.changes and not dry_run:
                if not (maps or yes):
                    _confirm(found)
                enter(services, found)
        _tell(found, campaign, dry_run, as_json)

    command.__doc__ = words
    return command


channels = _command(
    "",
    """Import readings, such as loads and temperatures, into the states of a campaign.

    Rows belong to states by their label or by their time. load[kN] and displacement[um] are those of the
    state; any other name is a channel, whose unit becomes the end of its name. All or nothing is changed.

    Example: sms import channels log.csv -c wing --map 'Force=load[kN]' --map 'T1=temperature[C]'
    --time-column Time --time-zone Europe/Berlin
    """,
)
gauges = _command(
    "um/m",
    """Import strain gauges into the states of a campaign: um/m, unless a column says another unit.

    Strains are stored as ratios. 'sms data gauges' shows those beside virtual gauges of the same name.

    Example: sms import gauges gauges.csv -c wing --state-column State --map 'SG1=G1'
    """,
)


def _confirm(found: Arranged) -> None:
    for column in found.columns:
        output.say(f"guessed: {column.header} becomes {column.target}")
    confirm(f"Enter {number_of(len(found.changes), 'value')} of {found.source}?")


def _tell(entered: Arranged, campaign: str, dry_run: bool, as_json: bool) -> None:
    remarks = [*entered.remarks, *(f"{c.header} becomes {c.target}" for c in entered.columns)]
    if as_json:
        body: dict[str, Any] = {
            "campaign": campaign,
            "dry_run": dry_run,
            "states": [r.state for r in entered.readings],
            "changes": entered.changes,
            "left_out": entered.left_out,
            "remarks": remarks,
        }
        output.print_json(body)
    else:
        for remark in remarks:
            output.say(remark)
        output.say_left_out(entered.left_out)
        for change in entered.changes:
            output.print_sentence(change)
        end = f"campaign {campaign} is brought up to date"
        if dry_run or not entered.changes:
            end = "nothing was changed"
        values, states = number_of(len(entered.changes), "value"), number_of(len(entered.readings), "state")
        output.say(f"{values} of {states}; {end}")
    if not entered.readings:
        raise typer.Exit(_FINDINGS)
