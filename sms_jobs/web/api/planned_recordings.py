"""Plans of recordings: what is recorded next, and when, whether or not somebody is there."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Query
from pydantic import Field

from sms_jobs.app.measuring import planned_recordings, quick_looks
from sms_jobs.app.measuring.plan_wishes import LONGEST_EVERY_S, LONGEST_HOLD_S, MOST_COUNTS, PlanWish
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.shown.quick_looks import QuickLookView
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
    every_s: Annotated[
        float | None, Field(ge=1, le=LONGEST_EVERY_S, description="One after so many seconds.")
    ] = None
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
        Field(min_length=1, max_length=MOST_COUNTS, description="Numbers of cycles, a state at each."),
    ] = None
    hold_s: Annotated[
        float, Field(ge=0, le=LONGEST_HOLD_S, description="How long the channel must have stayed there.")
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
    def wish(self) -> PlanWish:
        """The same without the campaign."""
        given = self.model_dump(exclude={"campaign"})
        at_cycles = None if self.at_cycles is None else tuple(self.at_cycles)
        return PlanWish(
            **given | {"states": tuple(self.states), "at_cycles": at_cycles, "stop_if": tuple(self.stop_if)}
        )


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
    wish = body.wish
    found = planned_recordings.plan(
        services,
        body.campaign,
        wish.when,
        wish.states,
        ask=wish.ask,
        process=wish.process,
        look=wish.looked_at,
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
    done = planned_recordings.drop(services, body.campaign, body.states)
    return answer({"dropped": done.forgotten, "recorded": done.recorded, "running": done.running})
