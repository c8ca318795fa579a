"""Streams: cameras without a projector at a rate, whose frames become states of a campaign."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from sms_jobs.app.measuring.recordings import Started
from sms_jobs.app.rules import use_case
from sms_jobs.app.work.waiting import Waited, Waiting, wait_for
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs.planning.chosen import submitted
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from collections.abc import Callable

    from sms_jobs.kinds.recording.stream import StreamParameters
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.events import TypedEvent
    from sms_jobs.records.shown.streams import StreamOutcome, StreamRehearsal


@dataclass(frozen=True)
class Task:
    """What is to be streamed.

    Attributes
    ----------
    campaign
        Whose states the frames become.
    rate_hz, for_s
        How many frames of each camera a second, and for how long; with an event, how long that is waited for.
    around
        The event that frames are kept around; None to keep all.
    before_s, after_s
        What is kept before and after it.
    every
        Every so manyth moment becomes a state; the frames between lie beside the state before them.
    cameras
        By name; those of the campaign if there is none.
    rig, views
        Of a campaign that is to be made: the rig that has these cameras, and which of them measure together,
        as "C1C2"; two cameras do if nothing is said.
    """

    campaign: str
    rate_hz: float
    for_s: float
    around: TypedEvent | None = None
    before_s: float = 0.0
    after_s: float = 0.0
    every: int = 1
    cameras: tuple[str, ...] = ()
    rig: str | None = None
    views: str | None = None


@use_case(Right.READ)
def rehearse(services: Services, task: Task) -> StreamRehearsal:
    """Return what a stream would take, and what is missing for it.

    Raises
    ------
    NotFound
        The rig is not connected to this host, or there is no such campaign and no rig to make it for.
    InvalidInput
        The campaign has projectors or other cameras, or the event does not fit its channel.
    """
    return _rehearsed(services, *_asked(services, task)[1:])


@use_case(Right.RECORD)
def begin(services: Services, task: Task) -> Started:
    """Submit a stream, and make its campaign where there is none.

    Raises as `rehearse` does, and `InvalidInput` for what is missing for it.
    """
    # Which load the kinds; nothing else here needs them.
    from sms_jobs.jobs.archiving.registration import register_campaign
    from sms_jobs.jobs.recording import streams
    from sms_jobs.kinds.recording.stream import KIND

    there, campaign, parameters = _asked(services, task)
    lacking = _rehearsed(services, campaign, parameters).missing
    if lacking:
        raise InvalidInput("; ".join(lacking))
    now = datetime.now(UTC)
    if not there:
        register_campaign(services.catalogue, services.archive, campaign, None, now)
    with services.catalogue.writing() as session:
        number = streams.next_number(session, campaign.name)
        request = Request(KIND.name, parameters.model_dump() | {"number": number})
        done = submit(session, campaign.name, [request], now, Terms(by=services.actor.name))
    return Started(done.job_ids, 1, submitted(done, KIND.name))


@dataclass(frozen=True)
class Streamed:
    """How a stream ended, and what came of it."""

    waited: Waited
    outcome: StreamOutcome


@use_case(Right.READ)
def wait_for_stream(
    services: Services, begun: Started, tell: Callable[[Waiting], None] = lambda waiting: None
) -> Streamed:
    """Return what became of a stream, once it has ended."""
    from sms_jobs.jobs.recording import recordings, streams

    waited = wait_for(services, begun.jobs, tell=tell)
    with services.catalogue.reading() as session:
        return Streamed(waited, streams.outcome(recordings.verdicts(session, begun.jobs)))


def _rehearsed(services: Services, campaign: Campaign, parameters: StreamParameters) -> StreamRehearsal:
    from sms_jobs.jobs.recording import streams

    settings = services.settings
    return streams.rehearse(
        services.stations.rig(campaign.rig),
        campaign,
        parameters,
        settings.spool_folder,
        services.archive.room().free_bytes,
        settings.job_memory_limit_mb,
    )


def _asked(services: Services, task: Task) -> tuple[bool, Campaign, StreamParameters]:
    """Return whether the campaign is there, as which it is or is to be made, and what is asked of its job."""
    from sms_jobs.app.importing.outcomes import existing_campaign
    from sms_jobs.kinds.recording.stream import KIND, campaigns_of_cameras

    existing = existing_campaign(services, task.campaign)
    campaign = _new(task) if existing is None else existing
    if not campaigns_of_cameras(campaign):
        raise InvalidInput(
            f"campaign {campaign.name} is measured by {', '.join(campaign.views)}: streams are for "
            f"cameras without a projector; name another campaign, with a rig to create it"
        )
    cameras = campaign.recordings
    if task.cameras and {*task.cameras} != {*cameras}:
        raise InvalidInput(
            f"campaign {campaign.name} has the cameras {', '.join(cameras)}, and a state has an image of "
            "each: leave `cameras` out, or name another campaign, with a `rig` to create it"
        )
    given = {
        "rate_hz": task.rate_hz,
        "for_s": task.for_s,
        "before_s": task.before_s,
        "after_s": task.after_s,
        "every": task.every,
    }
    if task.around is not None:
        event = task.around.in_unit(services.stations.unit(campaign.rig, task.around.channel))
        given |= vars(event)
    parameters = KIND.checked_parameters(campaign.processing.get(KIND.name, {}) | given)
    return existing is not None, campaign, parameters


def _new(task: Task) -> Campaign:
    """Return the campaign that is to be made; its reference is the first frame of the stream."""
    from sms_jobs.app.importing.image_views import views_asked_for, views_of_all
    from sms_jobs.records.campaign import Campaign, LoadState, Specimen
    from sms_jobs.records.streams import frame_label
    from sms_jobs.records.views import Role, role_of

    if task.rig is None or not task.cameras:
        raise NotFound(
            f"there is no campaign '{task.campaign}': create it with 'sms campaign create', or give "
            "`cameras` and a `rig` to create it here"
        )
    for number, name in enumerate(task.cameras):
        if role_of(name) is not Role.CAMERA:
            raise InvalidInput(
                f"{name} is a projector, and streams are of cameras: leave it out of `cameras`"
            )
        if name in task.cameras[:number]:
            raise InvalidInput(f"`cameras` names {name} twice: name each once")
    if task.views is None and len(task.cameras) > 2:
        raise InvalidInput(
            f"{len(task.cameras)} cameras may measure together in many ways: give `views`, such as "
            "'C1C2 C2C3'"
        )
    views = (
        views_of_all(task.cameras, task.rig, None)
        if task.views is None
        else views_asked_for(task.views, task.cameras)
    )
    first = LoadState(frame_label(1, 1))
    return Campaign(task.campaign, Specimen(task.campaign), task.rig, (first,), views.views)
