"""Recordings: states of a campaign, with the instruments of a rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.app.work.waiting import Waited, Waiting, wait_for
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.asking.campaign_progress import progress_of
from sms_jobs.jobs.planning.chosen import Chosen, by_ids, submitted
from sms_jobs.jobs.planning.graph import PIPELINE, Request
from sms_jobs.jobs.planning.submission import Terms, submit_to
from sms_jobs.jobs.recording import recordings
from sms_jobs.jobs.recording.recordings import OpenRecording, PairVerdict, Turn
from sms_jobs.jobs.running import orders
from sms_jobs.kinds.recording.names import ACQUIRE
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.people import Right
from sms_jobs.records.shown.rehearsals import DryRun
from sms_jobs.records.shown.state_progress import StateProgress

if TYPE_CHECKING:
    from sms_jobs.jobs.devices.stations import Stations
    from sms_jobs.records.campaign import Campaign, LoadState


@dataclass(frozen=True)
class Plan:
    """What is to be recorded.

    Attributes
    ----------
    campaign
        As it is defined.
    states
        Those that were asked for.
    lacking
        What the rig lacks for them, if it is connected to this host.
    """

    campaign: Campaign
    states: tuple[LoadState, ...]
    lacking: tuple[str, ...] = ()

    def turns(self, *, at_key: bool = False) -> list[Turn]:
        """Return the states that are recorded one after the other without a person.

        A new turn begins where a person is needed, and with `at_key` at every state.
        """
        return recordings.turns(self.states, at_key=at_key)


@use_case(Right.READ)
def plan(services: Services, campaign: str, states: Sequence[str] = (), *, missing: bool = False) -> Plan:
    """Return some states of a campaign, or all; of these, with `missing`, those that are not recorded yet.

    Raises `NotFound` where there is no such campaign or state.
    """
    return _plan(services, campaign, states, missing=missing)


def _plan(services: Services, campaign: str, states: Sequence[str], *, missing: bool = False) -> Plan:
    with services.catalogue.reading() as session:
        found = definition(campaign_row(session, campaign))
        chosen = [found.state(label) for label in states] or list(found.states)
        if missing:
            left = {s.label for s in recordings.unrecorded(session, campaign)}
            chosen = [s for s in chosen if s.label in left]
    views = [view for state in chosen for view in found.recordings_at(state.label)]
    return Plan(found, tuple(chosen), lacking(services.stations, found, views))


def lacking(stations: Stations, campaign: Campaign, views: Sequence[str]) -> tuple[str, ...]:
    """Say what the rig of a campaign lacks to record some views.

    Nothing is known of a rig that is connected to another host.
    """
    if not views or campaign.rig not in stations.names():
        return ()
    # Which loads the kinds; nothing else here needs them.
    from sms_jobs.jobs.recording.lacking import lacking

    return tuple(lacking(stations.rig(campaign.rig), campaign, views))


def refuse_lacking(lacking: Sequence[str]) -> None:
    """Raise `InvalidInput` where a rig lacks something."""
    if lacking:
        raise InvalidInput("; ".join(lacking))


@use_case(Right.READ)
def rehearse(services: Services, plan: Plan) -> DryRun:
    """Return what recording some states would take, and what is missing for it.

    Raises `NotFound` where the rig is not connected to this host.
    """
    # Which loads all instruments; nothing else here needs them.
    from sms_jobs.jobs.recording import dry_runs

    rig, settings = services.stations.rig(plan.campaign.rig), services.settings
    with services.catalogue.reading() as session:
        return dry_runs.dry_run(
            session, rig, plan.campaign, plan.states, settings.spool_folder, services.archive
        )


@dataclass(frozen=True)
class Started:
    """Jobs that record, and those that were submitted with them; `recordings` is how many record."""

    job_ids: tuple[str, ...]
    recordings: int
    jobs: Chosen


@use_case(Right.RECORD)
def record(
    services: Services, campaign: str, states: tuple[str, ...], *, ask: bool = False, process: bool = False
) -> Started:
    """Submit recordings of some states.

    Parameters
    ----------
    ask
        Ask an operator about a doubtful set instead of keeping it.
    process
        Process each state as soon as it is recorded.

    Raises
    ------
    NotFound
        There is no such campaign or state.
    InvalidInput
        No state is named, or the rig lacks what they are recorded with.
    """
    if not states:
        raise InvalidInput(f"no state of {campaign} is chosen: choose at least one that is to be recorded")
    refuse_lacking(_plan(services, campaign, states).lacking)
    requests = recordings.requests(states, ask=ask, process=process)
    now, terms = datetime.now(UTC), Terms(by=services.actor.name)
    done = submit_to(services.catalogue, campaign, requests, now, terms)
    return Started(done.job_ids, done.kinds.count(ACQUIRE), submitted(done, ACQUIRE))


@use_case(Right.COMPUTE)
def process(services: Services, campaign: str) -> int:
    """Submit what follows from the recordings of a campaign, and return how many jobs that is."""
    now, terms = datetime.now(UTC), Terms(by=services.actor.name)
    return len(submit_to(services.catalogue, campaign, [Request(PIPELINE)], now, terms).job_ids)


@dataclass(frozen=True)
class Recorded:
    """How recordings ended, and how good each set is."""

    waited: Waited
    verdicts: tuple[PairVerdict, ...]


@use_case(Right.READ)
def wait_for_recordings(
    services: Services, begun: Started, tell: Callable[[Waiting], None] = lambda waiting: None
) -> Recorded:
    """Return what became of recordings, once they have ended."""
    waited = wait_for(services, begun.jobs, tell=tell)
    with services.catalogue.reading() as session:
        return Recorded(waited, tuple(recordings.verdicts(session, begun.jobs)))


@use_case(Right.READ)
def open_recordings(services: Services) -> list[OpenRecording]:
    """Return the recordings that run, or wait for an operator."""
    with services.catalogue.reading() as session:
        return recordings.open_recordings(session, services.settings.spool_folder)


@use_case(Right.RECORD)
def resume(services: Services, prefix: str, *, retake: bool = False) -> Started:
    """Go on with a recording that was interrupted: what is there is kept, the rest is recorded.

    Parameters
    ----------
    prefix
        Beginning of its job's id.
    retake
        Record the doubtful sets again; their frames are kept too.

    Raises
    ------
    NotFound
        There is no such job.
    InvalidInput
        It is no recording.
    Conflict
        It cannot go on, or has no doubtful set.
    """
    with services.catalogue.writing() as session:
        row = recordings.recording_row(session, prefix)
        if retake and not recordings.forget_doubtful(services.stations.spool_of(row.id)):
            short = row.id[:SHORT_ID]
            raise Conflict(f"job {short} has no doubtful set to record again; leave out `retake`")
        orders.retry(session, row.id, datetime.now(UTC), services.actor.name)
        return Started((row.id,), 1, by_ids([row.id]))


@use_case(Right.RECORD)
def abort(services: Services, prefix: str | None = None) -> list[str]:
    """Stop a recording, or all, now, and return the ids of their jobs; complete frames stay.

    Raises `Conflict` where none runs, and as `resume` does.
    """
    with services.catalogue.writing() as session:
        if prefix is not None:
            ids = [recordings.recording_row(session, prefix).id]
        else:
            found = recordings.open_recordings(session, services.settings.spool_folder)
            ids = [r.job_id for r in found if r.state in (JobState.QUEUED, JobState.RUNNING)]
        now, by = datetime.now(UTC), services.actor.name
        stopped = [i for i in ids if orders.cancel(session, i, now, by)]
    if not stopped:
        raise Conflict("no recording runs; nothing was stopped")
    return stopped


@use_case(Right.READ)
def progress(services: Services, campaign: str, states: Sequence[str] = ()) -> list[StateProgress]:
    """Return what is recorded of each state, how good it is, and what is known of it already.

    Parameters
    ----------
    states
        Labels of those of which it is returned; all if empty.
    """
    with services.catalogue.reading() as session:
        return progress_of(session, campaign, states)
