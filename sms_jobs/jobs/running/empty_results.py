"""Jobs that have succeeded and found nothing: their results have no valid value, and say why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import Select, and_, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import search
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.records.job import JobState
from sms_jobs.records.statistic_names import VALID_FRACTION_OF_IMAGE, fraction_of_points, losses, lost_to

_MOST_ASKED = 20  # results
_MOST_TOLD = 2  # reasons
_LEAST_TOLD = 0.01  # of the pixels


@dataclass(frozen=True)
class EmptyResults:
    """The results of some jobs in which nothing is valid: how many, and what the latest tells."""

    count: int = 0
    latest: str = ""


def empty_results(session: Session, some: Chosen, began: datetime) -> EmptyResults:
    """Return which of some jobs have succeeded without a valid value.

    Where those that had ended before are not meant, it is those that have ended since `began`.
    """
    found = _empty().where(*some.where)
    if some.ended_before:
        found = found.where(JobRow.finished_at >= began)
    count = session.scalar(select(func.count()).select_from(found.subquery())) or 0
    if not count:
        return EmptyResults()
    some_latest = session.execute(found.order_by(FileRow.id.desc()).limit(_MOST_ASKED)).all()
    # What is made of an empty result is as empty, and cannot say why.
    latest = next(
        (one for one in some_latest if _reasons(search.statistics(session, one.file_id))), some_latest[0]
    )
    return EmptyResults(count, f"{latest.kind} {latest.subject}: {explanation(session, latest.file_id)}")


def explanations(session: Session, job: JobRow) -> list[str]:
    """Return what is to be said of a job whose result has no valid value; nothing of any other."""
    found = session.execute(_empty().where(JobRow.id == job.id)).all()
    return [explanation(session, one.file_id) for one in found]


def explanation(session: Session, file_id: int) -> str:
    """Say by which reasons a file has no valid value."""
    return _told(search.statistics(session, file_id))


def told_of_empty(results: Iterable[Mapping[str, float]]) -> str:
    """Say by which reasons a result of several has no valid value, by their statistics; "" where all have."""
    return next((_told(one) for one in results if one.get(VALID_FRACTION_OF_IMAGE) == 0.0), "")


def _told(statistics: Mapping[str, float]) -> str:
    told = _reasons(statistics)
    return f"nothing valid: {told}" if told else "nothing valid"


def _reasons(statistics: Mapping[str, float]) -> str:
    """Return what took most of the pixels of a file, or of the points that were matched; "" if unknown."""
    for what, part in (("lit pixels", lost_to), ("points", fraction_of_points)):
        lost = losses(statistics, part)
        worst = sorted((n for n in lost if lost[n] >= _LEAST_TOLD), key=lambda n: -lost[n])[:_MOST_TOLD]
        if worst:
            return f"of the {what} are lost " + " and ".join(f"{lost[n]:.0%} by {n}" for n in worst)
    return ""


def _empty() -> Select[str, str, int]:
    """Select jobs that have succeeded, with each file of theirs in which nothing is valid."""
    made_by = func.coalesce(JobRow.reused_from, JobRow.id)
    without = and_(
        StatisticRow.file_id == FileRow.id,
        StatisticRow.name == VALID_FRACTION_OF_IMAGE,
        StatisticRow.value == 0.0,
    )
    return (
        select(JobRow.kind, JobRow.subject, FileRow.id.label("file_id"))
        .join(FileRow, FileRow.job_id == made_by)
        .join(StatisticRow, without)
        .where(JobRow.state == JobState.SUCCEEDED)
    )
