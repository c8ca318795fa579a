"""`sms import channels|gauges`: tables of readings become channels of a campaign's states."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.cli import output
from sms_jobs.cli.import_options import CampaignName
from sms_jobs.cli.import_outcomes import confirm
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.readings import (
    Column,
    Reading,
    Table,
    read_table,
    readings_of,
    states_by_label,
    states_by_time,
    zone_named,
)
from sms_jobs.jobs.importing import amend_campaign, measured_at, with_readings

_FINDINGS = 6
_TOLD = 20
_STATE_NAMES = ("state", "label", "step", "load step")
_TIME_NAMES = ("time", "timestamp", "date", "datetime")

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


@dataclass(frozen=True)
class _Wanted:
    """Of which campaign readings are, which columns are meant, how rows find states, and what may change."""

    campaign: str
    maps: list[str] | None
    state_column: str | None
    time_column: str | None
    time_zone: str | None
    within: timedelta
    unit: str
    replace: bool
    dry_run: bool
    yes: bool


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
        table = read_table(file, delimiter, decimal)
        wanted = _Wanted(
            campaign,
            maps,
            state_column,
            time_column,
            time_zone,
            timedelta(seconds=within),
            unit,
            replace,
            dry_run,
            yes,
        )
        with bootstrap.services(home) as services:
            entered = _enter(services, table, wanted)
        _tell(table, entered, wanted, as_json)

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


@dataclass(frozen=True)
class _Entered:
    """What a table told, what was left out of it, and what it changes, in words."""

    columns: list[Column]
    readings: tuple[Reading, ...]
    left_out: list[str]
    changes: list[str]


def _enter(services: Services, table: Table, wanted: _Wanted) -> _Entered:
    """Find the states of the rows, and give the campaign what they say of them."""
    key, by_time = _key_column(table, wanted.state_column, wanted.time_column)
    columns = _columns(table, wanted.maps, key, wanted.unit)
    with services.catalogue.reading() as session:
        before = campaigns.definition(campaigns.campaign_row(session, wanted.campaign))
        times = measured_at(session, before)
    if by_time:
        if not times:
            raise InvalidInput(
                f"no state of campaign {wanted.campaign} has a time or a measurement: give --state-column "
                "instead"
            )
        zone = None if wanted.time_zone is None else zone_named(wanted.time_zone)
        states, left_out = states_by_time(table, table.column(key), times, zone, wanted.within)
    else:
        states, left_out = states_by_label(table, table.column(key), [s.label for s in before.states])
    found = readings_of(table, states, columns)
    after, changes = with_readings(before, found.readings, replace_others=wanted.replace)
    if changes and not wanted.dry_run:
        if not (wanted.maps or wanted.yes):
            _confirm(table, columns, changes)
        amend_campaign(services.catalogue, services.archive, before, after, datetime.now(UTC))
    return _Entered(columns, found.readings, [*left_out, *found.left_out], changes)


def _key_column(table: Table, state: str | None, time: str | None) -> tuple[str, bool]:
    """Return the column that finds states, and whether it holds times."""
    if state is not None and time is not None:
        raise InvalidInput("give --state-column or --time-column, not both")
    if state is not None:
        return state, False
    if time is not None:
        return time, True
    for names, by_time in ((_STATE_NAMES, False), (_TIME_NAMES, True)):
        for header in table.header:
            if header.lower() in names:
                return header, by_time
    raise InvalidInput(
        f"{table.source} has no column 'state' or 'time': say --state-column or --time-column; it has "
        f"{', '.join(table.header[:20])}"
    )


def _columns(table: Table, maps: list[str] | None, key: str, unit: str) -> list[Column]:
    """Return what the columns become: as they are mapped, or all of them by their own names."""
    if maps:
        columns = []
        for text in maps:
            header, equals, target = text.rpartition("=")
            if not equals or not header.strip():
                raise InvalidInput(f"--map should be as in 'Force=load[kN]', not '{text}'")
            table.column(header.strip())
            columns.append(Column.parse(header.strip(), target.strip(), unit))
        return columns
    columns = []
    for header in table.header:
        if header and header != key:
            stem, bracket, rest = header.partition("[")
            name = re.sub(r"[^A-Za-z0-9._-]+", "_", stem.strip()).strip("_")
            columns.append(Column.parse(header, name.lower() + bracket + rest, unit))
    if not columns:
        raise InvalidInput(f"{table.source} has no column besides '{key}'")
    return columns


def _confirm(table: Table, columns: list[Column], changes: list[str]) -> None:
    for column in columns:
        output.say(f"guessed: {column.header} becomes {column.target}")
    confirm(f"Enter {len(changes)} values of {table.source}?")


def _tell(table: Table, entered: _Entered, wanted: _Wanted, as_json: bool) -> None:
    remarks = [*table.remarks, *(f"{c.header} becomes {c.target}" for c in entered.columns)]
    if as_json:
        body: dict[str, Any] = {
            "campaign": wanted.campaign,
            "dry_run": wanted.dry_run,
            "states": [r.state for r in entered.readings],
            "changes": entered.changes,
            "left_out": entered.left_out,
            "remarks": remarks,
        }
        output.print_json(body)
    else:
        for remark in remarks:
            output.say(remark)
        for text in entered.left_out[:_TOLD]:
            output.say(f"left out: {text}")
        if len(entered.left_out) > _TOLD:
            output.say(f"left out: {len(entered.left_out) - _TOLD} more; --json lists all")
        for change in entered.changes:
            output.print_sentence(change)
        end = f"campaign {wanted.campaign} is brought up to date"
        if wanted.dry_run or not entered.changes:
            end = "nothing was changed"
        output.say(f"{len(entered.changes)} values of {len(entered.readings)} states; {end}")
    if not entered.readings:
        raise typer.Exit(_FINDINGS)
