"""Recordings: states of a campaign, with the instruments of a rig."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import Query
from fastapi.responses import Response
from pydantic import Field

from sms_jobs.app.measuring import last_frames, recordings
from sms_jobs.records.shown.last_frames import LastFrame
from sms_jobs.records.shown.rehearsals import DryRun
from sms_jobs.web.api.files import PNG
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Name, RequestBody, Text, Texts
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("recordings")

Labels = Annotated[list[Text], Query(default_factory=list, description="Of states; all if not given.")]


class NewRecordings(RequestBody):
    """States that are to be recorded."""

    campaign: Text
    # That there is one the use case asks for, in words for whoever has ticked none.
    states: Annotated[Texts, Field(description="Labels, in order.", json_schema_extra={"minItems": 1})]
    ask: Annotated[bool, Field(description="Ask an operator about a doubtful set.")] = False
    process: Annotated[bool, Field(description="Process each state once it is recorded.")] = False


class Going(RequestBody):
    """A recording that is to go on."""

    job: Annotated[Text, Field(description="Id of the job, or its beginning.")]
    retake: Annotated[bool, Field(description="Record the doubtful sets again.")] = False


class Aborting(RequestBody):
    """A recording that is to stop."""

    job: Annotated[Text | None, Field(description="Its id or beginning; all if not given.")] = None


class Processing(RequestBody):
    """A campaign whose recordings are to be processed."""

    campaign: Text


@dataclass(frozen=True)
class BegunRecordings:
    """Jobs that were submitted; `recordings` is how many of them record."""

    jobs: tuple[str, ...]
    recordings: int


@dataclass(frozen=True)
class Planned:
    """States that are to be recorded; in `turns`, those that go without a person between them."""

    campaign: str
    rig: str
    states: tuple[str, ...]
    turns: tuple[tuple[str, ...], ...]


@ROUTES.offer("GET", "/recordings", recordings.open_recordings, answers=returned(recordings.open_recordings))
def open_recordings(services: Acting) -> Any:
    """Return the recordings that run or wait."""
    return answer(recordings.open_recordings(services))


@ROUTES.offer("POST", "/recordings", recordings.record, answers=BegunRecordings, status=201)
def record(services: Acting, body: NewRecordings) -> Any:
    """Record states."""
    begun = recordings.record(services, body.campaign, tuple(body.states), ask=body.ask, process=body.process)
    return answer(BegunRecordings(begun.job_ids, begun.recordings), 201)


@ROUTES.offer("GET", "/recordings/plan", recordings.plan, answers=Planned)
def plan(services: Acting, campaign: Text, states: Labels, missing: bool = False) -> Any:
    """Say which states would be recorded."""
    found = recordings.plan(services, campaign, states, missing=missing)
    turns = tuple(turn.labels for turn in found.turns())
    labels = tuple(state.label for state in found.states)
    return answer(Planned(found.campaign.name, found.campaign.rig, labels, turns))


@ROUTES.offer("GET", "/recordings/rehearsal", recordings.rehearse, answers=DryRun)
def rehearse(services: Acting, campaign: Text, states: Labels, missing: bool = False) -> Any:
    """Say what recording states would take."""
    found = recordings.plan(services, campaign, states, missing=missing)
    return answer(recordings.rehearse(services, found))


@ROUTES.offer("POST", "/recordings/process", recordings.process, answers=dict[str, int])
def process(services: Acting, body: Processing) -> Any:
    """Process what was recorded."""
    return answer({"submitted": recordings.process(services, body.campaign)})


@ROUTES.offer("POST", "/recordings/resume", recordings.resume, answers=BegunRecordings)
def resume(services: Acting, body: Going) -> Any:
    """Go on with a recording."""
    begun = recordings.resume(services, body.job, retake=body.retake)
    return answer(BegunRecordings(begun.job_ids, begun.recordings))


@ROUTES.offer("POST", "/recordings/abort", recordings.abort)
def abort(services: Acting, body: Aborting) -> Any:
    """Stop recordings now."""
    return answer({"stopped": recordings.abort(services, body.job)})


@ROUTES.offer("GET", "/recordings/{job}/frame", last_frames.last_frame, answers=LastFrame)
def frame(services: Acting, job: Name) -> Any:
    """Return what is known of the newest frame."""
    return answer(last_frames.last_frame(services, job))


@ROUTES.offer("GET", "/recordings/{job}/frame.png", last_frames.last_picture, media=(PNG,))
def frame_picture(
    services: Acting,
    job: Name,
    of: Annotated[
        Text, Query(description="Any text: a browser fetches the picture again where it differs.")
    ] = "",
) -> Any:
    """Return the newest frame as a small picture."""
    return Response(last_frames.last_picture(services, job), media_type=PNG)
