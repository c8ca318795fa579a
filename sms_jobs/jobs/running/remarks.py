"""What jobs that have succeeded remark about their data."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.records.job import JobState
from sms_jobs.records.remarks import PARTED, remarks_in
from sms_jobs.records.shown.remarks import Remarks

_MOST_TOLD = 3  # of a kind


def remarks(session: Session, some: Chosen, began: datetime) -> tuple[Remarks, ...]:
    """Return what some jobs remark, by kind, in order.

    Where those that had ended before are not meant, it is those that have ended since `began`.
    """
    place = func.row_number().over(partition_by=JobRow.kind, order_by=JobRow.position).label("place")
    jobs = func.count().over(partition_by=JobRow.kind).label("jobs")
    noted = JobRow.message.contains(PARTED, autoescape=True)
    found = select(JobRow.kind, JobRow.subject, JobRow.message, place, jobs).where(
        *some.where, JobRow.state == JobState.SUCCEEDED, noted
    )
    if some.ended_before:
        found = found.where(JobRow.finished_at >= began)
    each = found.subquery()
    told: dict[str, Remarks] = {}
    for row in session.execute(select(each).where(each.c.place <= _MOST_TOLD).order_by(each.c.place)):
        before = told[row.kind].first if row.kind in told else ()
        said = f"{row.subject}: {remarks_in(row.message)}"
        told[row.kind] = Remarks(row.kind, row.jobs, (*before, said))
    return tuple(told.values())
