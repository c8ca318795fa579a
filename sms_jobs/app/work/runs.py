"""Named runs: what was submitted under a name, kept or forgotten."""

from __future__ import annotations

from datetime import UTC, datetime

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.asking import runs
from sms_jobs.records.people import Right
from sms_jobs.records.shown.runs import RunStory, RunView


@use_case(Right.READ)
def list_runs(services: Services) -> list[RunView]:
    """Return the runs, the newest first."""
    with services.catalogue.reading() as session:
        return runs.views(session)


@use_case(Right.READ)
def show(services: Services, name: str) -> RunStory:
    """Return a run with the results that it names; raises `NotFound` where there is none of that name."""
    with services.catalogue.reading() as session:
        return runs.story(session, name)


@use_case(Right.COMPUTE)
def keep(services: Services, name: str, reason: str) -> RunStory:
    """Keep what a run names, and all that it was computed from, whatever a policy removes.

    Nothing is added to it from then on.

    Raises
    ------
    NotFound
        There is no such run.
    Conflict
        It is kept already, or has jobs that have not ended.
    """
    with services.catalogue.writing() as session:
        runs.keep(session, name, reason, datetime.now(UTC))
        return runs.story(session, name)


@use_case(Right.COMPUTE)
def drop(services: Services, name: str) -> None:
    """Forget a name: its jobs, results and measurements stay, and a policy decides about results again.

    Raises `NotFound` where there is no such run.
    """
    with services.catalogue.writing() as session:
        runs.drop(session, name)
