"""Schedules: rows that submit jobs at their times, once each, whoever looks and however late."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from typing import Any, Literal, TypeAlias

from sqlalchemy import delete, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.models import JobRow, ScheduleFireRow, ScheduleRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError
from sms_jobs.jobs.fire_times import Expression, next_times, parse_expression, times_until
from sms_jobs.jobs.planning import Existing, Request, plan
from sms_jobs.jobs.submission import submit
from sms_jobs.records.campaign import checked_name
from sms_jobs.records.job import ACTIVE

MissedFire: TypeAlias = Literal["skip", "once", "all"]
"""What becomes of fire times that nobody looked at in time: none, the last one, or each of them."""

_MOST_AT_ONCE = 100
"""Fire times of one schedule that are looked at in one go; older ones are as if they had never been."""


@dataclass(frozen=True)
class Order:
    """What a schedule submits: requests for a campaign."""

    campaign: str
    requests: tuple[Request, ...]
    priority: int = 0
    use_cache: bool = True

    def as_json(self) -> dict[str, Any]:
        """Return it as it is kept in the catalogue."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Order:
        """Read it back."""
        requests = tuple(
            Request(r["kind"], dict(r["parameters"]), tuple(r["states"]), tuple(r["pairs"]))
            for r in stored["requests"]
        )
        return cls(stored["campaign"], requests, stored["priority"], stored["use_cache"])


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


@dataclass(frozen=True)
class Fired:
    """What became of one fire time."""

    schedule: str
    fire_time: datetime
    outcome: str


def add(
    session: Session,
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
        There is no such campaign.
    """
    checked_name(name, "schedule")
    if _row(session, name) is not None:
        raise Conflict(f"there is a schedule '{name}' already; remove it, or choose another name")
    campaign = campaigns.definition(campaigns.campaign_row(session, order.campaign))
    # What it needs may come into being later: that it could run is enough.
    plan(campaign, order.requests, lambda need: Existing(file_id=0))
    if expression.form == "after":
        campaigns.campaign_id(session, expression.what)
    if expression.form == "at" and not next_times(expression, now, now - grace, 1):
        raise InvalidInput(f"{expression.what} is past; give a time to come")
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


def set_paused(session: Session, name: str, paused: bool) -> None:
    """Hold a schedule back, or let it go on; raise `NotFound` where there is none of that name."""
    _required(session, name).paused = paused


def remove(session: Session, name: str) -> None:
    """Remove a schedule; the jobs that it submitted stay."""
    row = _required(session, name)
    session.execute(delete(ScheduleFireRow).where(ScheduleFireRow.schedule_id == row.id))
    session.delete(row)


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
        coming = [] if row.paused else next_times(_expression(row), row.created_at, now, 1)
        views.append(
            ScheduleView(
                name=row.name,
                expression=row.expression,
                time_zone=row.time_zone,
                campaign=order.campaign,
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
    """Return the next times of a schedule; none for one that waits for a campaign."""
    row = _required(session, name)
    return next_times(_expression(row), row.created_at, now, count)


def fire_due(session: Session, now: datetime) -> list[Fired]:
    """Submit what is due, and say what became of every time that has passed.

    Several supervisors may call it at once: a time belongs to whoever enters it first.
    """
    fired = []
    for row in session.scalars(select(ScheduleRow).where(ScheduleRow.paused.is_(False))).all():
        for moment, outcome in _decided(row, _passed(session, row, now), now):
            done = _fire(session, row, moment, outcome, now)
            if done is not None:
                fired.append(Fired(row.name, moment, done))
    return fired


def _passed(session: Session, row: ScheduleRow, now: datetime) -> list[datetime]:
    """Return the times of a schedule that have passed since the last one that was dealt with."""
    expression = _expression(row)
    last = session.scalar(
        select(func.max(ScheduleFireRow.fire_time)).where(ScheduleFireRow.schedule_id == row.id)
    )
    if expression.form == "after":
        return [row.created_at] if last is None and _has_ended(session, expression.what) else []
    # A time given to the minute may be a little before the schedule was entered.
    since = last or row.created_at - timedelta(seconds=row.grace_s if expression.form == "at" else 0.0)
    return times_until(expression, row.created_at, since, now, _MOST_AT_ONCE)


def _has_ended(session: Session, campaign: str) -> bool:
    """Tell whether a campaign has had jobs and all of them have ended."""
    campaign_id = campaigns.campaign_id(session, campaign)
    states = set(session.scalars(select(JobRow.state).where(JobRow.campaign_id == campaign_id).distinct()))
    return bool(states) and not states & ACTIVE


def _decided(
    row: ScheduleRow, times: Sequence[datetime], now: datetime
) -> list[tuple[datetime, Literal["submit", "missed"]]]:
    """Return what is to become of each time: those in time are submitted, the others by the policy."""
    grace = timedelta(seconds=row.grace_s)
    waits = _expression(row).form == "after"
    late = [] if waits else [t for t in times if now - t > grace]
    rescued: list[datetime] = {"skip": [], "once": late[-1:], "all": late}[row.missed_fire]
    # Of missed times one run is enough when another is due anyway.
    if row.missed_fire == "once" and len(late) < len(times):
        rescued = []
    return [(t, "missed" if t in late and t not in rescued else "submit") for t in times]


def _fire(
    session: Session, row: ScheduleRow, moment: datetime, outcome: Literal["submit", "missed"], now: datetime
) -> str | None:
    """Enter a time and submit its jobs; None when another supervisor was faster."""
    entry = ScheduleFireRow(schedule_id=row.id, fire_time=moment, outcome=outcome)
    try:
        with session.begin_nested():
            session.add(entry)
    except IntegrityError:
        return None
    if outcome == "missed":
        return outcome
    order = Order.from_json(row.request)
    try:
        with session.begin_nested():
            done = submit(
                session,
                order.campaign,
                order.requests,
                now,
                priority=order.priority,
                use_cache=order.use_cache,
            )
        entry.outcome = f"submitted {len(done.job_ids)} jobs"
    except SmsError as error:
        entry.outcome = f"failed: {error}"
    return entry.outcome


def _expression(row: ScheduleRow) -> Expression:
    return parse_expression(row.expression, row.time_zone)


def _row(session: Session, name: str) -> ScheduleRow | None:
    return session.scalar(select(ScheduleRow).where(ScheduleRow.name == name))


def _required(session: Session, name: str) -> ScheduleRow:
    row = _row(session, name)
    if row is None:
        raise NotFound(f"there is no schedule '{name}'; 'sms schedule list' shows them")
    return row
