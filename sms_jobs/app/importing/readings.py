"""Tables of readings become channels of a campaign's states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
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
from sms_jobs.jobs.archiving.importing import amend_campaign, measured_at, with_readings
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

_STATE_NAMES = ("state", "label", "step", "load step")
_TIME_NAMES = ("time", "timestamp", "date", "datetime")


@dataclass(frozen=True)
class Task:
    """Of which campaign readings are, which columns are meant, how rows find states, and what may change.

    Attributes
    ----------
    file
        CSV file with a header.
    maps
        As "COLUMN=CHANNEL[UNIT]"; empty for all columns by their own names.
    state_column, time_column
        What finds the states; by its name if both are None.
    time_zone
        IANA name, of times that have none.
    within
        That a row may be away from its state.
    delimiter, decimal
        Of the file; found if they are None.
    unit
        Of columns that say none.
    replace
        Whether values that states have already are replaced.
    """

    file: Path
    campaign: str
    maps: tuple[str, ...] = ()
    state_column: str | None = None
    time_column: str | None = None
    time_zone: str | None = None
    within: timedelta = timedelta(seconds=2)
    delimiter: str | None = None
    decimal: str | None = None
    unit: str = ""
    replace: bool = False


@dataclass(frozen=True)
class Arranged:
    """What a table says about the states of a campaign, before anything is changed.

    Attributes
    ----------
    source, remarks
        Name of the file, and what there is to say of how it was read.
    columns, readings
        What its columns become, and what it says about each state.
    left_out, changes
        What was left out of it, and what it changes, in words.
    before, after
        The campaign.
    """

    source: str
    remarks: tuple[str, ...]
    columns: tuple[Column, ...]
    readings: tuple[Reading, ...]
    left_out: tuple[str, ...]
    changes: tuple[str, ...]
    before: Campaign
    after: Campaign


@use_case(Right.READ)
def arrange_readings(services: Services, task: Task) -> Arranged:
    """Find the states of a table's rows, and say what would change.

    Raises
    ------
    InvalidInput
        The table cannot be read, its columns are not found, or a state has another value already.
    NotFound
        There is no such campaign.
    """
    table = read_table(task.file, task.delimiter, task.decimal)
    key, by_time = _key_column(table, task.state_column, task.time_column)
    columns = _columns(table, task.maps, key, task.unit)
    with services.catalogue.reading() as session:
        before = campaigns.definition(campaigns.campaign_row(session, task.campaign))
        times = measured_at(session, before)
    if by_time:
        if not times:
            raise InvalidInput(
                f"no state of campaign {task.campaign} has a time or a measurement: give `state_column` "
                "instead"
            )
        zone = None if task.time_zone is None else zone_named(task.time_zone)
        states, left_out = states_by_time(table, table.column(key), times, zone, task.within)
    else:
        states, left_out = states_by_label(table, table.column(key), [s.label for s in before.states])
    found = readings_of(table, states, columns)
    after, changes = with_readings(before, found.readings, replace_others=task.replace)
    return Arranged(
        table.source,
        tuple(table.remarks),
        tuple(columns),
        found.readings,
        (*left_out, *found.left_out),
        tuple(changes),
        before,
        after,
    )


@use_case(Right.COMPUTE)
def enter(services: Services, found: Arranged) -> None:
    """Give the campaign what the table says of its states: all of it or nothing."""
    if found.changes:
        amend_campaign(services.catalogue, services.archive, found.before, found.after, datetime.now(UTC))


def _key_column(table: Table, state: str | None, time: str | None) -> tuple[str, bool]:
    """Return the column that finds states, and whether it holds times."""
    if state is not None and time is not None:
        raise InvalidInput("give `state_column` or `time_column`, not both")
    if state is not None:
        return state, False
    if time is not None:
        return time, True
    for names, by_time in ((_STATE_NAMES, False), (_TIME_NAMES, True)):
        for header in table.header:
            if header.lower() in names:
                return header, by_time
    raise InvalidInput(
        f"{table.source} has no column 'state' or 'time': give `state_column` or `time_column`; it has "
        f"{', '.join(table.header[:20])}"
    )


def _columns(table: Table, maps: Sequence[str], key: str, unit: str) -> list[Column]:
    """Return what the columns become: as they are mapped, or all of them by their own names."""
    if maps:
        columns = []
        for text in maps:
            header, equals, target = text.rpartition("=")
            if not equals or not header.strip():
                raise InvalidInput(f"a column is mapped as in 'Force=load[kN]', not '{text}'")
            table.column(header.strip())
            columns.append(Column.parse(header.strip(), target.strip(), unit))
        return columns
    columns = [Column.named_by(header, unit) for header in table.header if header and header != key]
    if not columns:
        raise InvalidInput(f"{table.source} has no column besides '{key}'")
    return columns
