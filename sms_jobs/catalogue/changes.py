"""Notes what has happened beside jobs, in the transaction of the change: neither is without the other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.changes import ChangeRow
from sms_jobs.catalogue.tables.planned import PlannedRecordingRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.changes import Followed
from sms_jobs.records.subject import Subject

_BROKEN_OFF = frozenset({JobState.FAILED, JobState.QUARANTINED, JobState.NEEDS_OPERATOR, JobState.CANCELLED})
"""States of a job of which is told that the recording has come to them; the plan itself notes the others."""


def enter(session: Session, topic: Followed, name: str, campaign: str, state: str, message: str = "") -> None:
    """Note a change of something; see `records.shown.changes.Change`."""
    session.add(ChangeRow(topic=topic.value, name=name, campaign=campaign, state=state, message=message))


def of_recordings(
    session: Session, campaign: str, labels: Iterable[str], state: str, message: str = ""
) -> None:
    """Note a change of the planned recordings of some states."""
    for label in labels:
        enter(session, Followed.RECORDING, str(Subject(campaign, label)), campaign, state, message)


def of_planned_jobs(session: Session, job_ids: Sequence[str], state: JobState, message: str) -> None:
    """Note that jobs have come to a state, where a planned recording has broken off by that."""
    if state not in _BROKEN_OFF:
        return
    for some in parts(job_ids):
        rows = session.execute(
            select(CampaignRow.name, LoadStateRow.label)
            .join(PlannedRecordingRow, PlannedRecordingRow.campaign_id == CampaignRow.id)
            .join(LoadStateRow, LoadStateRow.id == PlannedRecordingRow.state_id)
            .where(PlannedRecordingRow.job_id.in_(some))
        )
        for campaign, label in rows:
            of_recordings(session, campaign, [label], state.value, message)


def of_schedule(session: Session, name: str, campaign: str, state: str, message: str = "") -> None:
    """Note a change of a schedule of a campaign, or of several, whose name is empty then."""
    enter(session, Followed.SCHEDULE, name, campaign, state, message)
