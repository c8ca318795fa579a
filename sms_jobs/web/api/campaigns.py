"""Campaigns: made from the texts of their plans, listed and shown."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

from fastapi import Query
from pydantic import Field

from sms_jobs.app.measuring import recordings
from sms_jobs.app.specimens import campaign_matrix, campaigns, experiments
from sms_jobs.app.specimens.campaigns import Campaigns
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.shown.cells import Cell
from sms_jobs.records.shown.state_progress import StateProgress
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Limit, LongText, Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer
from sms_jobs.web.sent_texts import text_as_file

ROUTES = Routes("campaigns")


@dataclass(frozen=True)
class CampaignFacts:
    """A campaign that was made: how many states it has, and which views."""

    campaign: str
    states: int
    views: tuple[str, ...]


@dataclass(frozen=True)
class CampaignAnswer:
    """What is known of a campaign; `campaign` is its definition as the catalogue keeps it."""

    campaign: dict[str, Any]
    created_at: datetime
    plan: str | None
    jobs: dict[str, int]
    times: dict[str, datetime]


class NewCampaign(RequestBody):
    """A campaign, or a calibration session, that is to be made."""

    plan: Annotated[LongText, Field(description="Text of the plan, as of `sms campaign create`.")]


class NewState(RequestBody):
    """A state more, behind those that a campaign has."""

    label: Text
    load_n: Annotated[float | None, Field(ge=-1e12, le=1e12, description="As it is planned, in N.")] = None


class NewView(RequestBody):
    """A view more, from now on."""

    view: Annotated[Text, Field(description="As C2P1, C1C2 or C3.")]


@dataclass(frozen=True)
class AddedView:
    """The views of a campaign, and the states that the new one has not seen."""

    campaign: str
    views: tuple[str, ...]
    unseen: tuple[str, ...]


class NewExperiment(RequestBody):
    """An experiment on the virtual rig that is to be made."""

    experiment: Annotated[Text, Field(description="One of GET /experiments.")]
    name: Annotated[
        Text | None, Field(description="Of the campaign; that of the experiment if not given.")
    ] = None
    small: bool = False


def _facts(made: Campaign) -> CampaignFacts:
    return CampaignFacts(made.name, len(made.states), tuple(made.views))


@ROUTES.offer("GET", "/campaigns", campaigns.list_campaigns, answers=Campaigns)
def list_campaigns(services: Acting, limit: Limit = 50) -> Any:
    """Return the newest campaigns."""
    return answer(campaigns.list_campaigns(services, limit))


@ROUTES.offer("POST", "/campaigns", campaigns.create, answers=CampaignFacts, status=201)
def create(services: Acting, body: NewCampaign) -> Any:
    """Make a campaign from the text of its plan."""
    with text_as_file(body.plan, "plan.toml") as plan:
        return answer(_facts(campaigns.create(services, plan)), 201)


@ROUTES.offer("GET", "/campaigns/{name}", campaigns.show, answers=CampaignAnswer)
def show(services: Acting, name: Name) -> Any:
    """Return what is known of a campaign."""
    found = campaigns.show(services, name)
    return answer(CampaignAnswer(found.stored, found.created_at, found.plan, found.jobs, found.times))


@ROUTES.offer("GET", "/campaigns/{name}/progress", recordings.progress, answers=list[StateProgress])
def progress(services: Acting, name: Name) -> Any:
    """Return what is known of each state."""
    return answer(recordings.progress(services, name))


@ROUTES.offer("GET", "/campaigns/{name}/matrix", campaign_matrix.matrix, answers=list[Cell])
def matrix(
    services: Acting,
    name: Name,
    states: Annotated[list[Text], Query(description="Only of these; of all if not given.")] = [],  # noqa: B006
) -> Any:
    """Return what there is of each state, view and kind."""
    found = campaign_matrix.matrix(services, name, states)
    return answer(campaign_matrix.in_order(found, campaigns.definition(services, name)))


@ROUTES.offer("POST", "/campaigns/{name}/states", campaigns.add_state, answers=CampaignFacts, status=201)
def add_state(services: Acting, name: Name, body: NewState) -> Any:
    """Give a campaign one more state."""
    return answer(_facts(campaigns.add_state(services, name, body.label, body.load_n)), 201)


@ROUTES.offer("POST", "/campaigns/{name}/views", campaigns.add_view, answers=AddedView, status=201)
def add_view(services: Acting, name: Name, body: NewView) -> Any:
    """Let a campaign be measured by one more view."""
    made = campaigns.add_view(services, name, body.view)
    return answer(AddedView(made.name, tuple(made.views), made.unseen(body.view)), 201)


@ROUTES.offer("GET", "/experiments", experiments.list_experiments, answers=dict[str, str | int])
def list_experiments(services: Acting) -> Any:
    """Return the experiments of the virtual rig."""
    return answer(experiments.list_experiments(services))


@ROUTES.offer("POST", "/experiments", experiments.simulate, answers=list[CampaignFacts], status=201)
def simulate(services: Acting, body: NewExperiment) -> Any:
    """Make an experiment on the virtual rig."""
    made = experiments.simulate(services, body.experiment, body.name, small=body.small)
    return answer([_facts(campaign) for campaign in made], 201)
