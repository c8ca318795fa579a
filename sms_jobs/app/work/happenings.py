"""What has happened to jobs, planned recordings, calibrations and schedules, for those who follow it."""

from __future__ import annotations

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.monitoring import happenings
from sms_jobs.jobs.monitoring.happenings import Cursor as Cursor
from sms_jobs.jobs.monitoring.happenings import Happening as Happening
from sms_jobs.jobs.monitoring.happenings import News as News
from sms_jobs.jobs.monitoring.happenings import Ranges as Ranges
from sms_jobs.records.people import Right

MOST = 500
"""Changes of jobs, and other changes, that are returned at a time."""


def is_full(found: News) -> bool:
    """Return whether there may be more than was returned."""
    return max(len(found.jobs), len(found.changes)) >= MOST


@use_case(Right.READ)
def newest(services: Services) -> Cursor:
    """Return the numbers of the newest changes, of jobs and of other things; 0 where there are none."""
    with services.catalogue.reading() as session:
        return happenings.newest(session)


@use_case(Right.READ)
def happened(services: Services, after: Cursor, missing: tuple[Ranges, Ranges] = ((), ())) -> News:
    """Return what has happened since some changes, 500 changes of jobs and as many others at most.

    Parameters
    ----------
    after
        Numbers of those changes.
    missing
        Ranges of numbers up to them that had not been there, and are looked for again: first and last.
    """
    with services.catalogue.reading() as session:
        return happenings.happened(session, after, MOST, missing)
