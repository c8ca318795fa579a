"""Campaigns: made from their plans, listed and shown."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs.asking import inquiry, standing
from sms_jobs.jobs.asking.inquiry import CampaignView
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from sms_jobs.catalogue.valid_calibrations import UsedCalibration
    from sms_jobs.records.campaign import Campaign


def example(of: Literal["fringes", "stereo", "session"] = "fringes") -> str:
    """Return a plan to start from: of a test with fringes or by two cameras, or of a calibration session."""
    from sms_jobs.formats import configuration

    return {
        "fringes": configuration.example_campaign,
        "stereo": configuration.example_stereo,
        "session": configuration.example_session,
    }[of]()


@use_case(Right.COMPUTE)
def create(services: Services, plan: Path) -> Campaign:
    """Create a campaign, or a calibration session, from the file of its plan.

    Raises
    ------
    InvalidInput
        The plan cannot be read.
    Conflict
        There is a campaign of that name.
    """
    from sms_jobs.formats import configuration
    from sms_jobs.jobs.archiving.registration import register_campaign

    loaded = configuration.load_campaign(plan)
    register_campaign(
        services.catalogue,
        services.archive,
        loaded.campaign,
        loaded.calibration,
        datetime.now(UTC),
        loaded.text,
    )
    return loaded.campaign


@use_case(Right.RECORD)
def add_state(services: Services, name: str, label: str, load_n: float | None = None) -> Campaign:
    """Give a campaign one more state behind its own, while its test goes on, and return it.

    Nothing that is recorded changes, nor the plan that it was made from.

    Parameters
    ----------
    load_n
        As it is planned, in N; None where nothing is.

    Raises
    ------
    NotFound
        There is no such campaign.
    Conflict
        It has such a state, or is changed by somebody else just now.
    InvalidInput
        It is a calibration session, or the label is none.
    """
    # Which load the kinds; nothing else here needs them.
    from sms_jobs.jobs.archiving.importing import amend_campaign, with_state
    from sms_jobs.records.campaign import LoadState

    before = definition(services, name)
    after = with_state(before, LoadState(label, load_n))
    amend_campaign(services.catalogue, services.archive, before, after, datetime.now(UTC))
    return after


@use_case(Right.RECORD)
def add_view(services: Services, name: str, view: str) -> Campaign:
    """Let a campaign be measured by one more view from now on, while its test goes on, and return it.

    It does not see states that are recorded already and of which it has no frames. Unless it sees all that
    are recorded it measures shape, and no displacement: nobody knows how the specimen looked to it at rest.
    Of a view that came late and of which frames were brought in since, these count from now on.

    Raises
    ------
    NotFound
        There is no such campaign, or no rig is connected that could tell of a camera alone.
    Conflict
        It has that view, and no further frames of it; something of it is being recorded, or it is changed
        by somebody else just now.
    InvalidInput
        It is a calibration session, or this is no view; or the rig, its calibration or the scene of the
        virtual rig has no such sensor.
    """
    # Which load the kinds, and tables of calibrations and plans; nothing else here needs them.
    from sms_jobs.catalogue import valid_calibrations
    from sms_jobs.jobs.archiving.importing import amend_campaign, with_view
    from sms_jobs.jobs.recording.recordings import recorded_views, refuse_while_recording

    with services.catalogue.reading() as session:
        row = campaigns.campaign_row(session, name)
        before = campaigns.definition(row)
        used = valid_calibrations.used_for_campaign(session, row.id)
        recorded = recorded_views(session, name)
    after = with_view(before, view, recorded)
    _require_sensors(services, before, view, used[-1] if used else None)

    def allow(session: Session) -> None:
        refuse_while_recording(session, name)
        if recorded_views(session, name) != recorded:
            raise Conflict(f"a state of {name} was recorded just now; add the view again")

    amend_campaign(services.catalogue, services.archive, before, after, datetime.now(UTC), allow)
    return after


def _require_sensors(services: Services, campaign: Campaign, view: str, used: UsedCalibration | None) -> None:
    """Raise `InvalidInput` where a sensor of a view is none of the rig, of its scene or its calibration.

    Also where two that would measure together stand at one point of the scene.
    """
    from sms_jobs.records.baselines import refuse_one_place
    from sms_jobs.records.views import view_of

    seen = view_of(view)
    known: dict[str, tuple[str, ...]] = {}
    calibrated = ""
    if campaign.scene is not None:
        known["the scene of the virtual rig"] = tuple(s.name for s in campaign.scene.rig.sensors)
    # Of a camera alone nobody else can tell.
    if campaign.rig in services.stations.names() or not (known or seen.measures_shape):
        known[f"rig {campaign.rig}"] = services.stations.rig(campaign.rig).sensors
    if seen.measures_shape:
        if used is None:
            raise InvalidInput(
                f"{view} measures shape by a calibration, and none of rig {campaign.rig} is in use: certify "
                "or import one first; see 'sms calibration list'"
            )
        calibrated = f"calibration {used.number}, which is in use for rig {campaign.rig},"
        known[calibrated] = tuple(used.sensors)
    for what, sensors in known.items():
        wanted = seen.triangulating if what == calibrated else seen.sensors
        lacking = [sensor for sensor in wanted if sensor not in sensors]
        if lacking:
            raise InvalidInput(
                f"{what} has no {' and no '.join(lacking)}, and so no view {view}; it has "
                f"{', '.join(sensors)}"
            )
    if campaign.scene is not None:
        refuse_one_place(map(campaign.scene.rig.sensor, seen.triangulating), "the scene of the virtual rig")


@dataclass(frozen=True)
class Campaigns:
    """The newest campaigns, and how many there are in all."""

    newest: tuple[CampaignView, ...]
    total: int


@use_case(Right.READ)
def list_campaigns(services: Services, limit: int = 50) -> Campaigns:
    """Return campaigns, the newest first."""
    with services.catalogue.reading() as session:
        rows = inquiry.list_campaigns(session, limit)
        return Campaigns(tuple(rows), standing.number_of_campaigns(session))


@use_case(Right.READ)
def names(services: Services) -> list[str]:
    """Return the names of all campaigns."""
    with services.catalogue.reading() as session:
        return inquiry.campaign_names(session)


@use_case(Right.READ)
def definition(services: Services, name: str) -> Campaign:
    """Return a campaign as it is defined; raises `NotFound` where there is none of that name."""
    with services.catalogue.reading() as session:
        return campaigns.definition(campaigns.campaign_row(session, name))


@dataclass(frozen=True)
class CampaignStory:
    """What is known of a campaign.

    Attributes
    ----------
    campaign, stored
        As it is defined, and as the catalogue keeps that.
    created_at
        When it was made.
    plan
        The test plan that it was made from, letter by letter; None where a program made it.
    jobs
        How many are in each state.
    times
        When states were measured, by label.
    """

    campaign: Campaign
    stored: dict[str, Any]
    created_at: datetime
    plan: str | None
    jobs: dict[str, int]
    times: dict[str, datetime]


@dataclass(frozen=True)
class CampaignOverview:
    """What a campaign is, when and from which plan it was made, and how many jobs are in each state."""

    campaign: Campaign
    created_at: datetime
    plan: str | None
    jobs: dict[str, int]


@use_case(Right.READ)
def overview(services: Services, name: str) -> CampaignOverview:
    """Return what is shown of a campaign again and again; raises as `show` does."""
    with services.catalogue.reading() as session:
        row = campaigns.campaign_row(session, name)
        return CampaignOverview(
            campaigns.shown_definition(session, row),
            row.created_at,
            row.plan,
            inquiry.counts(session, Chosen(campaign_id=row.id)),
        )


@use_case(Right.READ)
def show(services: Services, name: str) -> CampaignStory:
    """Return what is known of a campaign; raises `NotFound` where there is none of that name."""
    from sms_jobs.catalogue import valid_calibrations

    with services.catalogue.reading() as session:
        row = campaigns.campaign_row(session, name)
        return CampaignStory(
            campaigns.definition(row),
            row.definition,
            row.created_at,
            row.plan,
            inquiry.counts(session, Chosen(campaign_id=row.id)),
            valid_calibrations.state_times(session, row.id),
        )
