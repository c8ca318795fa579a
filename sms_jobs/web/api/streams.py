"""Streams: cameras without a projector at a rate, whose frames become states."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from sms_jobs.app.measuring import streams
from sms_jobs.app.measuring.streams import Task
from sms_jobs.errors import InvalidInput
from sms_jobs.records.events import typed_event
from sms_jobs.records.shown.streams import StreamRehearsal
from sms_jobs.web.api.recordings import BegunRecordings
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import RequestBody, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("streams")

_LONGEST_AROUND_S = 3600.0
Around = Annotated[float | None, Field(ge=0, le=_LONGEST_AROUND_S, description="With `around`.")]


class NewStream(RequestBody):
    """What is to be streamed, and whose states its frames become."""

    campaign: Text
    rate_hz: Annotated[float, Field(ge=1e-4, le=1e4, description="Frames of each camera a second.")]
    for_s: Annotated[
        float,
        Field(
            ge=1e-3, le=7 * 86400, description="How long; with `around`, how long the event is waited for."
        ),
    ]
    around: Annotated[
        Text | None,
        Field(description="Keep frames around this event: 'load_n > 20kN' or 'load_n drops 2kN in 1s'."),
    ] = None
    before_s: Around = None
    after_s: Around = None
    every: Annotated[int, Field(ge=1, le=100_000, description="Every so manyth moment becomes a state.")] = 1
    cameras: Annotated[
        list[Text], Field(max_length=100, description="By name; those of the campaign if not given.")
    ] = []
    rig: Annotated[Text | None, Field(description="Make the campaign for this rig where there is none.")] = (
        None
    )
    views: Annotated[Text | None, Field(description="Of a campaign that is made, as 'C1C2'.")] = None

    @property
    def task(self) -> Task:
        """What the use case is given; raises `InvalidInput` for what does not go together."""
        if (self.around is None) is not (self.before_s is None and self.after_s is None):
            raise InvalidInput(
                "before_s and after_s say what is kept around an event, 'load_n > 9kN': give them with around"
            )
        return Task(
            self.campaign,
            self.rate_hz,
            self.for_s,
            None if self.around is None else typed_event(self.around, "around"),
            self.before_s or 0.0,
            self.after_s or 0.0,
            self.every,
            tuple(self.cameras),
            self.rig,
            self.views,
        )


@ROUTES.offer("POST", "/streams", streams.begin, answers=BegunRecordings, status=201)
def begin(services: Acting, body: NewStream) -> Any:
    """Stream cameras."""
    begun = streams.begin(services, body.task)
    return answer(BegunRecordings(begun.job_ids, begun.recordings), 201)


@ROUTES.offer("POST", "/streams/rehearsal", streams.rehearse, answers=StreamRehearsal)
def rehearse(services: Acting, body: NewStream) -> Any:
    """Say what a stream would take."""
    return answer(streams.rehearse(services, body.task))
