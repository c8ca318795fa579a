"""Of jobs that compute the same at the same time one does; the others wait, and reuse its result.

Else what is submitted twice would be computed twice, and what was made of the first result would be stale
where the second differs from it in a last digit.
"""

from __future__ import annotations

from typing import cast

from sqlalchemy import BigInteger, ColumnElement, Table, and_, bindparam, exists, func, select, update
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import LeaseLost
from sms_jobs.records.job import JobState

_JOB = cast(Table, JobRow.__table__)
_HOLD = select(func.pg_advisory_xact_lock(bindparam("number", type_=BigInteger())))
_COMPUTING = (
    select(_JOB.c.id)
    .where(
        _JOB.c.reuse_key == bindparam("key"),
        _JOB.c.state == JobState.RUNNING,
        _JOB.c.repeatable,
        _JOB.c.id != bindparam("job"),
    )
    .limit(1)
)
_NOTE = (
    update(_JOB)
    .where(_JOB.c.id == bindparam("job"), _JOB.c.fence == bindparam("held"), _JOB.c.state == JobState.RUNNING)
    .values(reuse_key=bindparam("key"))
    .returning(_JOB.c.id)
)


def take(session: Session, job_id: str, fence: int, key: str, *, giving_way: bool) -> str | None:
    """Note that an attempt computes what has a reuse key, unless it gives way to a job that does so already.

    Returns
    -------
    That job, or None.

    Raises
    ------
    LeaseLost
        The attempt does not run any more.
    """
    if session.get_bind().dialect.name == "postgresql":
        # Of two that begin at the same moment, the second sees what the first has noted.
        session.execute(_HOLD, {"number": int(key[:15], 16)})
    if giving_way and (other := session.scalar(_COMPUTING, {"key": key, "job": job_id})) is not None:
        return str(other)
    if session.execute(_NOTE, {"job": job_id, "held": fence, "key": key}).one_or_none() is None:
        raise LeaseLost("a newer attempt has started")
    return None


def is_computed() -> ColumnElement[bool]:
    """Return whether another job computes what a row of `job` gave way to when it was claimed before."""
    other = aliased(JobRow)
    # One that may not reuse anything would gain nothing. Most rows have no key: no more is asked of them.
    return and_(
        JobRow.reuse_key.is_not(None),
        JobRow.use_cache,
        exists().where(
            other.reuse_key == JobRow.reuse_key, other.state == JobState.RUNNING, other.repeatable
        ),
    )
