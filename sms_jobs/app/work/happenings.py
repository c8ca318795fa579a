"""What has happened to jobs, for those who follow it."""

from __future__ import annotations

from collections.abc import Sequence

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.monitoring import happenings
from sms_jobs.jobs.monitoring.happenings import Happening as Happening
from sms_jobs.records.people import Right

MOST = 500
"""Changes that are returned at a time."""


@use_case(Right.READ)
def newest(services: Services) -> int:
    """Return the number of the newest change of a job; 0 where there is none."""
    with services.catalogue.reading() as session:
        return happenings.newest(session)


@use_case(Right.READ)
def happened(services: Services, after: int, missing: Sequence[tuple[int, int]] = ()) -> list[Happening]:
    """Return what has happened to jobs since a change, 500 changes at most.

    Parameters
    ----------
    after
        Number of that change.
    missing
        Ranges of numbers up to it that had not been there, and are looked for again: first and last.
    """
    with services.catalogue.reading() as session:
        return happenings.happened(session, after, MOST, missing)
