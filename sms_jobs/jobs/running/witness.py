"""Tells which other supervisors are gone: by their beats, and never by anybody's clock."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.running.origin import Origin, is_gone
from sms_jobs.jobs.running.stillness import Stillness
from sms_jobs.records.job import JobState

_LONGEST_STEP_S = 2.0
"""A witness looks every second. When it could not, nobody may have been able to beat either."""


class Witness:
    """One supervisor's memory of the others' beats.

    Parameters
    ----------
    worker_id
        Its own.
    here
        Where it is.
    """

    def __init__(self, worker_id: str, here: Origin) -> None:
        self._worker_id = worker_id
        self._here = here
        self._beats: Stillness[str] = Stillness(_LONGEST_STEP_S)

    def silent(self, session: Session, now: float) -> list[str]:
        """Return the supervisors that hold jobs and have not beaten for as long as their lease.

        One that was where this one is, and whose process is gone, is silent at once.

        Parameters
        ----------
        now
            Seconds of this process's monotonic clock.
        """
        holds = select(JobRow.worker_id).where(JobRow.state == JobState.RUNNING)
        others = session.scalars(
            select(WorkerRow).where(WorkerRow.id.in_(holds), WorkerRow.id != self._worker_id)
        ).all()
        still_s = self._beats.look({row.id: row.beats for row in others}, now)
        return [
            row.id
            for row in others
            if still_s[row.id] > row.lease_s or is_gone(row.pid, origin_of(row), self._here)
        ]


def origin_of(row: WorkerRow) -> Origin:
    """Return where a supervisor says that it is."""
    return Origin(row.machine, row.boot, row.pid_namespace, row.process_started)
