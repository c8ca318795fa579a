"""Plans of recordings: which state of a test is recorded next, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs import planned_recordings
from sms_jobs.records.people import Right
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.triggers import Every, InTurn, Trigger

if TYPE_CHECKING:
    pass


@dataclass(frozen=True)
class InTime:
    """Record the states one after the other, so many seconds apart; without a time in turn, at once."""

    every_s: float | None = None


When = InTime


@use_case(Right.RECORD)
def plan(
    services: Services,
    campaign: str,
    when: When,
    states: Sequence[str] = (),
    *,
    ask: bool = False,
    process: bool = False,
) -> list[PlannedRecording]:
    """Plan recordings, behind those that are planned, and return the whole plan of the campaign.

    Parameters
    ----------
    when
        What each of them waits for. A state that is planned already waits for this instead.
    states
        All that are neither recorded nor planned nor skipped if there is none.
    ask, process
        See `recordings.record`.

    Raises
    ------
    NotFound
        There is no such campaign or state.
    Conflict
        A state is recorded, or being recorded; or nothing is left.
    InvalidInput
        The campaign is a calibration session, before whose poses somebody has to be there.
    """
    # Which loads the kinds; nothing else here needs them.
    from sms_jobs.jobs import due_recordings

    now = datetime.now(UTC)
    with services.catalogue.reading() as session:
        left = due_recordings.plannable(session, campaign, states)
    wanted = [(state.label, _trigger(when)) for state in left]
    with services.catalogue.writing() as session:
        planned_recordings.put(session, campaign, wanted, services.actor.name, now, ask=ask, process=process)
        return planned_recordings.shown(session, now, campaign)


def _trigger(when: When) -> Trigger:
    return InTurn() if when.every_s is None else Every(when.every_s)


@use_case(Right.READ)
def show(services: Services, campaign: str | None = None) -> list[PlannedRecording]:
    """Return the plan of a campaign, or all with something left; raise `NotFound` where there is none."""
    with services.catalogue.reading() as session:
        return planned_recordings.shown(session, datetime.now(UTC), campaign)


@use_case(Right.RECORD)
def hold(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Hold planned recordings back, or all of them, and return the states of which that is new.

    Raises
    ------
    NotFound
        There is no such campaign, or nothing is planned of such a state.
    Conflict
        One has begun already.
    """
    with services.catalogue.writing() as session:
        return planned_recordings.set_held(session, campaign, states, True)


@use_case(Right.RECORD)
def go(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Let recordings that were held back go on, and return their states; raises as `hold` does."""
    with services.catalogue.writing() as session:
        return planned_recordings.set_held(session, campaign, states, False)


@use_case(Right.RECORD)
def skip(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Leave planned recordings out, or the next one, and return their states.

    Raises
    ------
    NotFound
        There is no such campaign, or nothing is planned of such a state.
    Conflict
        One is recorded, or being recorded.
    """
    with services.catalogue.writing() as session:
        return planned_recordings.skip(session, campaign, states)


@use_case(Right.RECORD)
def move(services: Services, campaign: str, state: str, before: str | None = None) -> None:
    """Let a planned recording come before another one, or last.

    Raises
    ------
    NotFound
        There is no such campaign, or nothing is planned of such a state.
    Conflict
        One of them has begun already, or is skipped.
    """
    with services.catalogue.writing() as session:
        planned_recordings.move(session, campaign, state, before)


@use_case(Right.RECORD)
def drop(services: Services, campaign: str, states: Sequence[str] = ()) -> list[str]:
    """Forget recordings of a plan, or all that do not run, and return their states.

    What was recorded stays; raises as `skip` does.
    """
    with services.catalogue.writing() as session:
        return planned_recordings.drop(session, campaign, states)
