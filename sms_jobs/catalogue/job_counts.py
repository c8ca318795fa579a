"""How many jobs there are of each campaign, kind, queue and state, without looking at every job.

Triggers of the database keep the table `job_count` in the transaction that changes a job, whoever changes it:
it is right at every commit. On SQLite, where one at a time writes, they change one row of each key. On
PostgreSQL each change adds rows of its own, so that no two transactions wait for one row; the number is their
sum, and `fold` adds them up now and then.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from sqlalchemy import delete, func, insert, select, text
from sqlalchemy.orm import InstrumentedAttribute, Session

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.records.job import JobState

TRIGGERS = frozenset({"job_count_added", "job_count_changed", "job_count_removed"})
_KEY = ("campaign_id", "kind", "queue", "state")
_ONE_AT_A_TIME = 7_401_926_331
"""A number of this program, by which PostgreSQL lets one at a time fold."""
_FOLD = """
    WITH gone AS (DELETE FROM job_count WHERE part <> 0 RETURNING campaign_id, kind, queue, state, jobs)
    INSERT INTO job_count (campaign_id, kind, queue, state, part, jobs)
    SELECT campaign_id, kind, queue, state, 0, sum(jobs) FROM gone GROUP BY campaign_id, kind, queue, state
    ON CONFLICT (campaign_id, kind, queue, state, part) DO UPDATE SET jobs = job_count.jobs + excluded.jobs
"""


def counted(
    session: Session,
    *by: InstrumentedAttribute[Any],
    campaigns: Collection[int] | None = None,
    kind: str | None = None,
    states: Collection[JobState] | None = None,
) -> dict[tuple[Any, ...], int]:
    """Return how many jobs there are by columns of `JobCountRow`, those of which there is none left out.

    Parameters
    ----------
    by
        Columns, by whose values the numbers are told apart.
    campaigns, kind, states
        Only of these campaigns, which are few enough for one statement, of this kind, or in these states.
    """
    query = select(*by, func.sum(JobCountRow.jobs)).group_by(*by).having(func.sum(JobCountRow.jobs) != 0)
    if campaigns is not None:
        query = query.where(JobCountRow.campaign_id.in_(campaigns))
    if kind is not None:
        query = query.where(JobCountRow.kind == kind)
    if states is not None:
        query = query.where(JobCountRow.state.in_(states))
    return {tuple(row[:-1]): int(row[-1]) for row in session.execute(query)}


def by_state(
    session: Session, campaigns: Collection[int] | None = None, kind: str | None = None
) -> dict[str, int]:
    """Return how many jobs are in each state; parameters are those of `counted`."""
    kept = counted(session, JobCountRow.state, campaigns=campaigns, kind=kind)
    return {state.value: count for (state,), count in kept.items()}


def fold(catalogue: Catalogue) -> None:
    """Add up what changes of jobs have left on PostgreSQL, which is read whenever jobs are counted."""
    if catalogue.dialect == "sqlite":
        return
    with catalogue.writing() as session:
        session.execute(text("SELECT pg_advisory_xact_lock(:number)"), {"number": _ONE_AT_A_TIME})
        session.execute(text(_FOLD))
        session.execute(delete(JobCountRow).where(JobCountRow.part == 0, JobCountRow.jobs == 0))


def differ(session: Session) -> bool:
    """Say whether the counts are others than those of the jobs themselves, all of which are looked at."""
    columns = _keys_of_jobs()
    query = select(*columns, func.count()).group_by(*columns)
    jobs = {tuple(row[:-1]): row[-1] for row in session.execute(query)}
    return jobs != counted(session, *(getattr(JobCountRow, name) for name in _KEY))


def count_again(session: Session) -> None:
    """Count all jobs anew; nobody may change one meanwhile."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("LOCK TABLE job IN SHARE MODE"))
    columns = _keys_of_jobs()
    jobs = select(*columns, text("0"), func.count()).group_by(*columns)
    session.execute(delete(JobCountRow))
    session.execute(insert(JobCountRow).from_select([*_KEY, "part", "jobs"], jobs))


def _keys_of_jobs() -> list[InstrumentedAttribute[Any]]:
    # Whoever asks for counts alone need not map the jobs themselves.
    from sms_jobs.catalogue.tables.jobs import JobRow

    return [getattr(JobRow, name) for name in _KEY]
