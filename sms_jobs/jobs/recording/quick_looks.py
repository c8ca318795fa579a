"""Quick looks at recorded states: what they have found, and plans of recordings that they stop."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from datetime import datetime

from sqlalchemy import and_, func, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue import changes
from sms_jobs.catalogue.campaigns import campaign_id, campaign_row, definition
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.planned import PlannedRecordingRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.jobs.notifying import occurrences
from sms_jobs.jobs.recording import planned_levels
from sms_jobs.jobs.recording.planned_recordings import AWAITED
from sms_jobs.records.gauge_limits import GaugeLimit
from sms_jobs.records.job import ACTIVE, SHORT_ID, JobState
from sms_jobs.records.remarks import remarks_in
from sms_jobs.records.shown.notifications import Topic
from sms_jobs.records.shown.planned_recordings import Status
from sms_jobs.records.shown.quick_looks import GaugeLook, QuickLookView
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import (
    GAUGE_QUANTITIES,
    GAUGES,
    GAUGES_READ,
    VALID_FRACTION,
    gauges_in,
    of_gauge,
)
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import place_of_view

KIND = "quick-look"


def looks(session: Session, campaign: str, labels: Collection[str] = ()) -> list[QuickLookView]:
    """Return the newest quick look at each tuple of a campaign, or of some of its states, in order.

    Raises `NotFound` where there is no such campaign.
    """
    defined = definition(campaign_row(session, campaign))
    number = campaign_id(session, campaign)
    newest = (
        # One that was reused has found nothing new.
        select(JobRow.subject, func.max(JobRow.position).label("position"))
        .where(JobRow.campaign_id == number, JobRow.kind == KIND, JobRow.reused_from.is_(None))
        .group_by(JobRow.subject)
        .subquery()
    )
    jobs = session.scalars(
        select(JobRow).join(
            newest, and_(JobRow.subject == newest.c.subject, JobRow.position == newest.c.position)
        )
    ).all()
    about = {Subject.parse(job.subject): job for job in jobs}
    order = {state.label: place for place, state in enumerate(defined.states)}
    wanted = [one for one in about if one.state in order and (not labels or one.state in labels)]
    wanted.sort(key=lambda one: (order[one.state or ""], place_of_view(one.view or "")))
    statistics = _statistics(session, [about[one].id for one in wanted])
    return [_view(one, about[one], statistics[about[one].id]) for one in wanted]


def _statistics(session: Session, job_ids: Sequence[str]) -> Mapping[str, dict[str, float]]:
    """Return what the quick looks of some jobs have found, by job and name."""
    found: defaultdict[str, dict[str, float]] = defaultdict(dict)
    rows = session.execute(
        select(FileRow.job_id, StatisticRow.name, StatisticRow.value)
        .join(StatisticRow, StatisticRow.file_id == FileRow.id)
        .where(FileRow.job_id.in_(job_ids))
        .order_by(StatisticRow.name)
    )
    for job_id, name, value in rows:
        found[str(job_id)][name] = value
    return found


def _view(subject: Subject, job: JobRow, statistics: Mapping[str, float]) -> QuickLookView:
    done = job.state is JobState.SUCCEEDED
    doubts = remarks_in(job.message) if done else job.error or job.message
    gauges = tuple(GaugeLook.of(name, statistics) for name in gauges_in(statistics))
    return QuickLookView(
        subject.campaign,
        subject.state or "",
        subject.view or "",
        job.id,
        job.state.value,
        job.finished_at if done else None,
        statistics.get(VALID_FRACTION),
        gauges,
        int(statistics.get(GAUGES, 0.0) - statistics.get(GAUGES_READ, 0.0)),
        "" if job.state in ACTIVE else doubts,
    )


def judge(catalogue: Catalogue, now: datetime) -> None:
    """Hold the plans whose last quick look is beyond a limit, or has no value for one, and tell of it.

    A plan waits for the quick look of a state with limits before it goes on. What is not known holds it as
    well: nobody is to load a specimen further because a look at it failed.
    """
    with catalogue.reading() as session:
        rows = session.execute(
            select(PlannedRecordingRow, CampaignRow.name, LoadStateRow.label)
            .join(CampaignRow, CampaignRow.id == PlannedRecordingRow.campaign_id)
            .join(LoadStateRow, LoadStateRow.id == PlannedRecordingRow.state_id)
            .where(AWAITED)
        ).all()
        verdicts = {
            (row.id, row.campaign_id): (name, label, words)
            for row, name, label in rows
            if (words := _verdict(session, row, name, label)) is not None
        }
    for (row_id, number), (name, label, words) in verdicts.items():
        with catalogue.writing() as session:
            judged = session.scalar(
                update(PlannedRecordingRow)
                .where(PlannedRecordingRow.id == row_id, AWAITED)
                .values(awaited=False, stopped_by=words or None)
                .returning(PlannedRecordingRow.id)
                .execution_options(synchronize_session=False)
            )
            if judged is None:
                continue
            changes.of_recordings(session, name, [label], "stopped" if words else "looked-at", words)
            if not words:
                continue
            session.execute(
                update(PlannedRecordingRow)
                .where(
                    PlannedRecordingRow.campaign_id == number,
                    PlannedRecordingRow.status == Status.PLANNED.value,
                )
                .values(held=True)
            )
            planned_levels.set_held(session, number, True)
            about = str(Subject(name, label))
            occurrences.enter(session, Topic.LIMIT_REACHED, name, about, now, words)


def _verdict(session: Session, row: PlannedRecordingRow, campaign: str, label: str) -> str | None:
    """Return why a plan is to stop after a state, nothing where it may go on, None before that is known."""
    defined = definition(campaign_row(session, campaign))
    if label == defined.reference.label:
        return ""  # what everything is compared with has not moved
    found = looks(session, campaign, [label])
    if any(one.status in {state.value for state in ACTIVE} for one in found):
        return None
    values: defaultdict[str, list[tuple[QuickLookView, float, float]]] = defaultdict(list)
    for one in found:
        for gauge in one.gauges:
            for quantity in GAUGE_QUANTITIES:
                values[of_gauge(gauge.name, quantity)].append((one, *gauge.read(quantity)))
    for limit in map(GaugeLimit.from_json, row.stop_if):
        there = values[limit.statistic]
        for one, value, sigma in there:
            if limit.is_reached(value):
                return (
                    f"{limit.gauge}.{limit.quantity} is {value:.4g} +- {sigma:.2g} mm in the quick look at "
                    f"{one.state}/{one.view}, and the plan stops where {limit}"
                )
        if not there:
            return f"{_why_none(found, label)}, and the plan stops where {limit}"
    return ""


def _why_none(found: Sequence[QuickLookView], label: str) -> str:
    """Say why a state's quick looks have no value of a gauge."""
    if not found:
        return f"there is no quick look at {label}"
    why = "; ".join(one.doubts or f"no value of {number_of(one.gauges_lost, 'gauge')}" for one in found)
    jobs = ", ".join(one.job_id[:SHORT_ID] for one in found)
    return f"the quick look at {label}, job {jobs}, does not tell it ({why})"
