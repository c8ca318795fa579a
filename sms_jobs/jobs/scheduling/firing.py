"""What fires schedules: times that have passed, and the jobs that are submitted for each, once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from typing import Literal

from sqlalchemy import and_, exists, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, changes
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow, ScheduleRow
from sms_jobs.errors import InvalidInput, NotFound, ServerUnreachable, SmsError
from sms_jobs.jobs.asking import runs
from sms_jobs.jobs.notifying import occurrences
from sms_jobs.jobs.planning.graph import given_parameters
from sms_jobs.jobs.planning.submission import Draft, Terms, draft, enter, while_outdated
from sms_jobs.jobs.scheduling.fire_times import times_until
from sms_jobs.jobs.scheduling.schedules import Order, campaigns_of, expression_of, run_of
from sms_jobs.records.job import ACTIVE
from sms_jobs.records.shown.notifications import Topic
from sms_jobs.records.sizes import number_of

_MOST_AT_ONCE = 100
"""Fire times of one schedule that are looked at in one go; older ones are as if they had never been."""


@dataclass(frozen=True)
class Fired:
    """What became of one fire time."""

    schedule: str
    fire_time: datetime
    outcome: str


def fire_due(catalogue: Catalogue, now: datetime) -> list[Fired]:
    """Submit what is due, and say what became of every time that has passed.

    Several supervisors may call it at once: a time belongs to whoever enters it first. Nothing is written
    while nothing is due, and what is due is planned before it is.
    """
    fired = []
    with catalogue.reading() as session:
        due = _due(session, now)
    for one in due:
        outcome = while_outdated(partial(_fire, catalogue, one, now))
        if outcome is not None:
            fired.append(Fired(one.schedule, one.moment, outcome))
    return fired


@dataclass(frozen=True)
class _Due:
    """A time that has passed, and what is to become of it; `run` is what the jobs are submitted under."""

    schedule_id: int
    schedule: str
    order: Order
    moment: datetime
    outcome: Literal["submit", "missed"]
    run: str | None


def _due(session: Session, now: datetime) -> list[_Due]:
    rows = session.scalars(select(ScheduleRow).where(ScheduleRow.paused.is_(False))).all()
    found = []
    for row in rows:
        order = Order.from_json(row.request)
        for moment, outcome in _decided(row, _passed(session, row, now), now):
            run = None if order.run is None else run_of(order.run, expression_of(row), moment)
            found.append(_Due(row.id, row.name, order, moment, outcome, run))
    return found


def _passed(session: Session, row: ScheduleRow, now: datetime) -> list[datetime]:
    """Return the times of a schedule that have passed since the last one that was dealt with."""
    expression = expression_of(row)
    latest = select(func.max(ScheduleFireRow.fire_time)).where(ScheduleFireRow.schedule_id == row.id)
    if expression.form == "after":
        waits = session.scalar(latest) is None
        return [row.created_at] if waits and _has_ended(session, expression.what) else []
    # A clock that was ahead may have dealt with times to come: those before them are due all the same.
    last = session.scalar(latest.where(ScheduleFireRow.fire_time <= now))
    # A time given to the minute may be a little before the schedule was entered.
    since = last or row.created_at - timedelta(seconds=row.grace_s if expression.form == "at" else 0.0)
    return times_until(expression, row.created_at, since, now, _MOST_AT_ONCE)


def _has_ended(session: Session, campaign: str) -> bool:
    """Tell whether a campaign has had jobs and all of them have ended."""
    of_campaign = JobRow.campaign_id == campaigns.campaign_id(session, campaign)
    active = exists().where(of_campaign, JobRow.state.in_(ACTIVE))
    return bool(session.scalar(select(and_(exists().where(of_campaign), ~active))))


def _decided(
    row: ScheduleRow, times: Sequence[datetime], now: datetime
) -> list[tuple[datetime, Literal["submit", "missed"]]]:
    """Return what is to become of each time: those in time are submitted, the others by the policy."""
    grace = timedelta(seconds=row.grace_s)
    waits = expression_of(row).form == "after"
    late = [] if waits else [t for t in times if now - t > grace]
    rescued: list[datetime] = {"skip": [], "once": late[-1:], "all": late}[row.missed_fire]
    # Of missed times one run is enough when another is due anyway.
    if row.missed_fire == "once" and len(late) < len(times):
        rescued = []
    return [(t, "missed" if t in late and t not in rescued else "submit") for t in times]


def _fire(catalogue: Catalogue, due: _Due, now: datetime) -> str | None:
    """Enter a time and its jobs; None when another supervisor was faster, or the schedule is gone."""
    planned: tuple[Draft, ...] = ()
    outcome: str = due.outcome
    refused = False
    if due.outcome == "submit":
        planned, outcome, refused = _planned(catalogue, due, now)
    with catalogue.writing() as session:
        try:
            with session.begin_nested():
                session.add(
                    ScheduleFireRow(schedule_id=due.schedule_id, fire_time=due.moment, outcome=outcome)
                )
        except IntegrityError:
            return None
        for one in planned:
            done = enter(session, one)
            if due.run is not None and done.job_ids:
                asked = given_parameters(due.order.requests)
                runs.enter(session, due.run, done, asked, now, _by(due.schedule))
        became = "missed" if due.outcome == "missed" else "fired" if planned else "failed"
        changes.of_schedule(session, due.schedule, due.order.campaign, became, outcome)
        if not planned or refused:
            what = f"schedule {due.schedule}, {due.moment.isoformat(timespec='minutes')}"
            occurrences.enter(session, Topic.SCHEDULE_MISSED, due.order.campaign, what, now, outcome)
    return outcome


def _by(schedule: str) -> str:
    return f"schedule {schedule}"


def _planned(catalogue: Catalogue, due: _Due, now: datetime) -> tuple[tuple[Draft, ...], str, bool]:
    """Return what can be planned of an order, what to say of it, and whether anything was refused."""
    drafts: list[Draft] = []
    refused: list[str] = []
    try:
        with catalogue.reading() as session:
            if due.run is not None:
                runs.require_open(session, due.run)
            for campaign, states in campaigns_of(session, due.order).items():
                try:
                    drafts.append(_draft(session, due, campaign, states, now))
                except (InvalidInput, NotFound) as error:
                    if due.order.where is None:
                        raise
                    refused.append(f"{campaign}: {error}")
    except ServerUnreachable:
        raise
    except SmsError as error:
        return (), f"failed: {error}", True
    if not drafts:
        return (), f"failed: {refused[0]}", True
    refused += [f"{one.subject}: {one.error}" for made in drafts for one in made.refused]
    outcome = f"submitted {number_of(sum(len(made.jobs) for made in drafts), 'job')}"
    if refused:
        first, others = refused[0], len(refused) - 1
        subject, _, why = first.partition(": ")
        outcome += f"; refused {subject}{f' and {others} more' if others else ''}: {why}"
    return tuple(drafts), outcome, bool(refused)


def _draft(session: Session, due: _Due, campaign: str, states: tuple[str, ...], now: datetime) -> Draft:
    order = due.order
    chosen = order.requests
    if order.where is not None:
        chosen = tuple(replace(request, states=states) for request in chosen)
    terms = Terms(order.priority, order.use_cache, _by(due.schedule))
    return draft(session, campaign, chosen, now, terms)
