"""Notes what subscribers are to be told, in the transaction of the change: neither is without the other."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from functools import cache
from typing import cast

from sqlalchemy import Insert, String, Table, bindparam, func, insert, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.columns import MessageText, UtcDateTime
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.notifications import OccurrenceRow
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.shown.notifications import OF_STATES, Topic


def of_jobs(session: Session, job_ids: Sequence[str], state: JobState, now: datetime, message: str) -> None:
    """Note that jobs have come to a state, if it is one that is told."""
    topic = OF_STATES.get(state)
    if topic is None:
        return
    for some in parts(job_ids):
        session.execute(_noting(), {"jobs": some, "topic": topic.value, "now": now, "said": message})


@cache
def _noting() -> Insert:
    about = JobRow.kind.concat(" ").concat(JobRow.subject).concat(", job ")
    told = select(
        bindparam("topic", type_=String()),
        CampaignRow.name,
        about.concat(func.substr(JobRow.id, 1, SHORT_ID)),
        bindparam("now", type_=UtcDateTime()),
        bindparam("said", type_=MessageText()),
    ).join(CampaignRow, CampaignRow.id == JobRow.campaign_id)
    told = told.where(JobRow.id.in_(bindparam("jobs", expanding=True)))
    columns = ["topic", "campaign", "about", "at", "message"]
    return insert(cast(Table, OccurrenceRow.__table__)).from_select(columns, told)


def enter(session: Session, topic: Topic, campaign: str, about: str, now: datetime, message: str) -> None:
    """Note something else that has happened."""
    session.add(OccurrenceRow(topic=topic.value, campaign=campaign, about=about, at=now, message=message))
