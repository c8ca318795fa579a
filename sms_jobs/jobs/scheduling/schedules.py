"""Schedules: rows that submit jobs at their times, once each, whoever looks and however late."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime, time, timedelta
from functools import partial
from itertools import islice, takewhile
from operator import gt
from typing import TYPE_CHECKING, Any, Literal, TypeAlias
from zoneinfo import ZoneInfo

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, changes
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow, ScheduleRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError
from sms_jobs.jobs.asking.found_states import states_to_submit
from sms_jobs.jobs.planning.graph import Existing, Request, plan
from sms_jobs.jobs.scheduling.fire_times import (
    Expression,
    fire_times,
    next_times,
    parse_expression,
)
from sms_jobs.records.shown.schedules import MOST_A_DAY, FiringsOfDay
from sms_jobs.records.subject import checked_name

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

_FIELDS = 5
MissedFire: TypeAlias = Literal["skip", "once", "all"]
"""What becomes of fire times that nobody looked at in time: none, the last one, or each of them."""


@dataclass(frozen=True)
class Order:
    """What a schedule submits: requests for a campaign, or for the states that meet a question.

    Attributes
    ----------
    campaign
        Empty where a question is asked.
    run
        Name of the run that the results belong to, if any; what fires again and again adds its time.
    where
        The question, in the language of docs/query.md; it is asked anew whenever the schedule fires.
    """

    campaign: str
    requests: tuple[Request, ...]
    priority: int = 0
    use_cache: bool = True
    run: str | None = None
    where: str | None = None

    @property
    def about(self) -> str:
        """What it is about, for people."""
        return self.campaign if self.where is None else f"where {self.where}"

    def as_json(self) -> dict[str, Any]:
        """Return it as it is kept in the catalogue."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Order:
        """Read it back."""
        requests = tuple(
            Request(r["kind"], dict(r["parameters"]), tuple(r["states"]), tuple(r["views"]))
            for r in stored["requests"]
        )
        return cls(
            stored["campaign"],
            requests,
            stored["priority"],
            stored["use_cache"],
            stored.get("run"),
            stored.get("where"),
        )


@dataclass(frozen=True)
class ScheduleView:
    """One schedule as it is shown."""

    name: str
    expression: str
    time_zone: str
    campaign: str
    kinds: tuple[str, ...]
    missed_fire: str
    grace_s: float
    paused: bool
    last_fire: datetime | None
    last_outcome: str | None
    next_fire: datetime | None

    @property
    def when(self) -> str:
        """Its expression as people read it."""
        return parse_expression(self.expression, self.time_zone).in_words


def add(
    catalogue: Catalogue,
    name: str,
    expression: Expression,
    order: Order,
    now: datetime,
    *,
    missed_fire: MissedFire = "once",
    grace: timedelta = timedelta(minutes=5),
) -> None:
    """Add a schedule.

    Parameters
    ----------
    missed_fire
        What becomes of times that are past by more than `grace` when a supervisor looks.

    Raises
    ------
    InvalidInput
        The name, or what it would submit, is impossible.
    Conflict
        There is a schedule of that name.
    NotFound
        There is no such campaign, or no state meets the question.
    """
    checked_name(name, "schedule")
    if order.run is not None:
        checked_name(run_of(order.run, expression, now), "run")
    with catalogue.reading() as session:
        _refuse_taken(session, name)
        found = campaigns_of(session, order)
        definitions = [campaigns.definition(campaigns.campaign_row(session, one)) for one in found]
        if expression.form == "after":
            campaigns.campaign_id(session, expression.what)
    # What it needs may come into being later: that it could run is enough, in one of several campaigns.
    errors = [error for one in definitions if (error := _objection(one, order)) is not None]
    if len(errors) == len(definitions):
        raise errors[0]
    if expression.form == "at" and not next_times(expression, now, now - grace, 1):
        raise InvalidInput(
            f"{expression.what} is past, by more than {grace.total_seconds():g} s of grace; give one to come"
        )
    if expression.form == "cron" and len(expression.what.split()) > _FIELDS:
        # With a sixth the first would be seconds, and an asterisk too many another time of the day.
        raise InvalidInput(
            f"'{expression.what}' has more than the {_FIELDS} fields of a cron expression: give minute, "
            "hour, day, month, weekday, without seconds"
        )
    if expression.form == "cron" and not next_times(expression, now, now, 1):
        raise InvalidInput(f"'{expression.what}' is at no time to come; give days that there are")
    with catalogue.writing() as session:
        _refuse_taken(session, name)
        session.add(
            ScheduleRow(
                name=name,
                expression=str(expression),
                time_zone=expression.zone.key,
                request=order.as_json(),
                missed_fire=missed_fire,
                grace_s=grace.total_seconds(),
                paused=False,
                created_at=now,
            )
        )
        changes.of_schedule(session, name, order.campaign, "added")


def campaigns_of(session: Session, order: Order) -> dict[str, tuple[str, ...]]:
    """Return the campaigns of an order with the states that it chooses; none for those that it names."""
    return {order.campaign: ()} if order.where is None else states_to_submit(session, order.where)


def _objection(campaign: Campaign, order: Order) -> SmsError | None:
    try:
        plan(campaign, order.requests, lambda need: Existing(file_id=0))
    except SmsError as error:
        return error
    return None


def run_of(run: str, expression: Expression, moment: datetime) -> str:
    """Return the name of the run of a firing: each has its own, since runs are there to be compared."""
    if expression.form in ("at", "after"):
        return run
    return f"{run}-{moment.astimezone(UTC):%Y%m%dT%H%M%SZ}"


def _refuse_taken(session: Session, name: str) -> None:
    if _row(session, name) is not None:
        raise Conflict(f"there is a schedule '{name}' already; remove it, or choose another name")


def set_paused(session: Session, name: str, paused: bool) -> None:
    """Hold a schedule back, or let it go on; raise `NotFound` where there is none of that name."""
    row = _required(session, name)
    if row.paused is not paused:
        row.paused = paused
        changes.of_schedule(session, name, row.request["campaign"], "paused" if paused else "resumed")


def remove(session: Session, name: str) -> None:
    """Remove a schedule; the jobs that it submitted stay."""
    row = _required(session, name)
    session.execute(delete(ScheduleFireRow).where(ScheduleFireRow.schedule_id == row.id))
    session.delete(row)
    changes.of_schedule(session, name, row.request["campaign"], "removed")


def schedules(session: Session, now: datetime) -> list[ScheduleView]:
    """Return every schedule, in order of name."""
    views = []
    for row in session.scalars(select(ScheduleRow).order_by(ScheduleRow.name)):
        order = Order.from_json(row.request)
        last = session.execute(
            select(ScheduleFireRow.fire_time, ScheduleFireRow.outcome)
            .where(ScheduleFireRow.schedule_id == row.id)
            .order_by(ScheduleFireRow.fire_time.desc())
            .limit(1)
        ).one_or_none()
        coming = [] if row.paused else next_times(expression_of(row), row.created_at, now, 1)
        views.append(
            ScheduleView(
                name=row.name,
                expression=row.expression,
                time_zone=row.time_zone,
                campaign=order.about,
                kinds=tuple(r.kind for r in order.requests),
                missed_fire=row.missed_fire,
                grace_s=row.grace_s,
                paused=row.paused,
                last_fire=None if last is None else last.fire_time,
                last_outcome=None if last is None else last.outcome,
                next_fire=coming[0] if coming else None,
            )
        )
    return views


def coming(session: Session, name: str, now: datetime, count: int) -> list[datetime]:
    """Return the next times of a schedule; none for one that is paused, or waits for a campaign."""
    row = _required(session, name)
    return [] if row.paused else next_times(expression_of(row), row.created_at, now, count)


def calendar(session: Session, first: date, days: int, zone: ZoneInfo, now: datetime) -> list[FiringsOfDay]:
    """Return when schedules that are not paused fire on days of a zone, later than `now`, day by day."""
    found = []
    for row in session.scalars(select(ScheduleRow).where(ScheduleRow.paused.is_(False))):
        expression, order = expression_of(row), Order.from_json(row.request)
        about = (row.name, order.about, tuple(r.kind for r in order.requests))
        after = max(now, _midnight(first, zone) - timedelta(microseconds=1))
        for day in (first + timedelta(days=k) for k in range(days)):
            end = _midnight(day + timedelta(days=1), zone)
            coming = takewhile(partial(gt, end), fire_times(expression, row.created_at, after))
            times = list(islice(coming, MOST_A_DAY))
            if times:
                found.append(FiringsOfDay(day, *about, times[0], len(times)))
            after = max(after, end - timedelta(microseconds=1))
    return sorted(found, key=lambda one: (one.day, one.first, one.schedule))


def _midnight(day: date, zone: ZoneInfo) -> datetime:
    return datetime.combine(day, time(), zone).astimezone(UTC)


def first_fire(session: Session, name: str, now: datetime) -> datetime | None:
    """Return when a schedule that was just added fires; None where that is up to another campaign.

    A time given to the minute may have just passed: it is due.
    """
    row = _required(session, name)
    since = now - timedelta(seconds=row.grace_s if expression_of(row).form == "at" else 0.0)
    return next(iter(next_times(expression_of(row), row.created_at, since, 1)), None)


def expression_of(row: ScheduleRow) -> Expression:
    """Return when a schedule fires."""
    return parse_expression(row.expression, row.time_zone)


def _row(session: Session, name: str) -> ScheduleRow | None:
    return session.scalar(select(ScheduleRow).where(ScheduleRow.name == name))


def _required(session: Session, name: str) -> ScheduleRow:
    row = _row(session, name)
    if row is None:
        raise NotFound(f"there is no schedule '{name}'; 'sms schedule list' shows them")
    return row
