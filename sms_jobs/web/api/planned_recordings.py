"""Plans of recordings: what is recorded next, and when, whether or not somebody is there."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any

from fastapi import Query
from pydantic import Field

from sms_jobs.app.measuring import planned_recordings, quick_looks
from sms_jobs.app.measuring.planned_recordings import AtCycles, AtLevels, AtLoad, InTime, When
from sms_jobs.errors import InvalidInput
from sms_jobs.records.gauge_limits import Look, gauge_limit
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.shown.quick_looks import QuickLookView
from sms_jobs.records.units import typed
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import RequestBody, Text, Texts
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("planned recordings")

States = Annotated[Texts, Field(description="Labels; all if not given.")]
Count = Annotated[int, Field(ge=0, le=10**15)]


class NewPlan(RequestBody):
    """States that are to be recorded, and one thing that each waits for; without any, the one before it."""

    campaign: Text
    states: Annotated[
        Texts, Field(description="Labels; all that are not recorded, planned or skipped if not given.")
    ] = []
    every_s: Annotated[float | None, Field(ge=1, le=30 * 86400, description="One after so many seconds.")] = (
        None
    )
    channel: Annotated[
        Text | None, Field(description="Whose value at a state is waited for; with `at_cycles`, that counts.")
    ] = None
    tolerance: Annotated[
        Text | None, Field(description="How near the channel has to be, with its unit, as 500N.")
    ] = None
    each: Annotated[
        Text | None,
        Field(
            description="Add a state at each multiple of this that the channel stays near, with its unit, as "
            "10kN, and record it there; goes with `channel` and `tolerance`, and without `states`."
        ),
    ] = None
    at_cycles: Annotated[
        list[Count] | None,
        Field(min_length=1, max_length=1000, description="Numbers of cycles, a state at each."),
    ] = None
    hold_s: Annotated[
        float, Field(ge=0, le=86400, description="How long the channel must have stayed there.")
    ] = 5.0
    ask: Annotated[bool, Field(description="Ask an operator about a doubtful set.")] = False
    process: Annotated[bool, Field(description="Process each state once it is recorded.")] = False
    look: Annotated[bool, Field(description="Take a quick look at each state once it is recorded.")] = False
    stop_if: Annotated[
        Texts,
        Field(
            description="Hold the plan where a quick look finds this, as g1.extension_mm > 0.5mm; `look` is "
            "not needed then."
        ),
    ] = []

    @property
    def looked_at(self) -> Look:
        """Whether there are quick looks, and which limits hold the plan; `InvalidInput` for anything else."""
        limits = tuple(gauge_limit(text, "stop_if") for text in self.stop_if)
        return Look(self.look or bool(limits), limits)

    @property
    def when(self) -> When:
        """What is waited for; raises `InvalidInput` for several things, or half of one."""
        at_load = self.channel is not None and self.at_cycles is None
        if [at_load, self.at_cycles is not None, self.every_s is not None].count(True) > 1:
            raise InvalidInput("give one thing to wait for: every_s, at_cycles, or channel with tolerance")
        if self.each is not None and not at_load:
            raise InvalidInput("each goes with channel and tolerance, and without at_cycles: leave it out")
        if at_load is (self.tolerance is None):
            raise InvalidInput(
                "channel and tolerance go together, and without at_cycles: state how near the channel "
                "must be "
                "to a state's value, such as 500N"
            )
        if self.at_cycles is not None:
            if any(later <= earlier for earlier, later in pairwise(self.at_cycles)):
                raise InvalidInput("at_cycles: each number should exceed the one before")
            return AtCycles(tuple(self.at_cycles), self.channel or "cycles", self.hold_s)
        if self.channel is not None and self.tolerance is not None and self.each is not None:
            each, tolerance = typed(self.each, "each"), typed(self.tolerance, "tolerance")
            return AtLevels(self.channel, each, tolerance, self.hold_s)
        if self.channel is not None and self.tolerance is not None:
            return AtLoad(self.channel, typed(self.tolerance, "tolerance"), self.hold_s)
        return InTime(self.every_s)


class PlannedStates(RequestBody):
    """States of the plan of a campaign."""

    campaign: Text
    states: States = []


class Moved(RequestBody):
    """A state of a plan, and before which other one it is to come."""

    campaign: Text
    state: Text
    before: Annotated[Text | None, Field(description="It comes last if not given.")] = None


@ROUTES.offer("GET", "/recordings/planned", planned_recordings.show, answers=list[PlannedRecording])
def show(
    services: Acting,
    campaign: Annotated[
        Text | None, Query(description="All plans with something left to record if not given.")
    ] = None,
) -> Any:
    """Return plans."""
    return answer(planned_recordings.show(services, campaign))


@ROUTES.offer("GET", "/recordings/looks", quick_looks.show, answers=list[QuickLookView])
def looks(services: Acting, campaign: Annotated[Text, Query(description="Of this one.")]) -> Any:
    """Return the newest quick look at each tuple of a campaign."""
    return answer(quick_looks.show(services, campaign))


@ROUTES.offer(
    "POST", "/recordings/planned", planned_recordings.plan, answers=list[PlannedRecording], status=201
)
def plan(services: Acting, body: NewPlan) -> Any:
    """Plan recordings."""
    found = planned_recordings.plan(
        services,
        body.campaign,
        body.when,
        body.states,
        ask=body.ask,
        process=body.process,
        look=body.looked_at,
    )
    return answer(found, 201)


@ROUTES.offer("POST", "/recordings/planned/hold", planned_recordings.hold, answers=dict[str, int | list[str]])
def hold(services: Acting, body: PlannedStates) -> Any:
    """Hold a plan back, or some of its states."""
    return answer({"held": planned_recordings.hold(services, body.campaign, body.states)})


@ROUTES.offer("POST", "/recordings/planned/go", planned_recordings.go, answers=dict[str, int | list[str]])
def go(services: Acting, body: PlannedStates) -> Any:
    """Let what was held back go on."""
    return answer({"going": planned_recordings.go(services, body.campaign, body.states)})


@ROUTES.offer("POST", "/recordings/planned/skip", planned_recordings.skip, answers=dict[str, int | list[str]])
def skip(services: Acting, body: PlannedStates) -> Any:
    """Leave states out, the next one if none is named."""
    return answer({"skipped": planned_recordings.skip(services, body.campaign, body.states)})


@ROUTES.offer("POST", "/recordings/planned/move", planned_recordings.move)
def move(services: Acting, body: Moved) -> Any:
    """Let a state come before another one, or last."""
    planned_recordings.move(services, body.campaign, body.state, body.before)
    return answer({"moved": body.state, "before": body.before})


@ROUTES.offer("POST", "/recordings/planned/drop", planned_recordings.drop, answers=dict[str, int | list[str]])
def drop(services: Acting, body: PlannedStates) -> Any:
    """Forget a plan, or some of its states."""
    return answer({"dropped": planned_recordings.drop(services, body.campaign, body.states)})
