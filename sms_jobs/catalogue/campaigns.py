"""Campaigns, their states and rigs in the catalogue."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Collection, Sequence
from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter
from sqlalchemy import func, insert, select
from sqlalchemy.orm import Session, undefer

from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow, SpecimenRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow
from sms_jobs.errors import Conflict, NotFound, did_you_mean

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign, LoadState

KEPT_DEFINITIONS = 16


def add_campaign(session: Session, campaign: Campaign, now: datetime, plan: str | None = None) -> None:
    """Add a campaign with its specimen, rig and states, and the text of the file that it was made from.

    Raises
    ------
    Conflict
        There is a campaign of that name.
    """
    refuse_taken_name(session, campaign.name)
    specimen = session.scalar(select(SpecimenRow).where(SpecimenRow.name == campaign.specimen.name))
    if specimen is None:
        specimen = SpecimenRow(
            name=campaign.specimen.name,
            material=campaign.specimen.material,
            description=campaign.specimen.description,
        )
        session.add(specimen)
    rig = rig_row(session, campaign.rig)
    session.flush()
    row = CampaignRow(name=campaign.name, specimen_id=specimen.id, rig_id=rig.id, created_at=now, plan=plan)
    define(row, campaign)
    session.add(row)
    session.flush()
    # By one statement each, since others wait who want to write.
    states = [
        {
            "campaign_id": row.id,
            "label": state.label,
            "position": position,
            **described(state),
        }
        for position, state in enumerate(campaign.states)
    ]
    session.execute(insert(LoadStateRow), states)
    numbers = state_ids(session, row.id)
    channels = [
        {"state_id": numbers[state.label], "name": name, "value": value}
        for state in campaign.states
        for name, value in state.channels.items()
    ]
    if channels:
        session.execute(insert(ChannelRow), channels)


def described(state: LoadState) -> dict[str, Any]:
    """Return what the row of a state tells of what is planned and what is known of it."""
    return {
        "planned_load_n": state.load_n,
        "planned_displacement_mm": state.displacement_mm,
        "load_n": state.known_load_n,
        "displacement_mm": state.known_displacement_mm,
        "time": state.time,
    }


def bring_up_to_date(session: Session, row: CampaignRow, after: Campaign) -> None:
    """Give a campaign of the catalogue the definition that continues its own."""
    define(row, after)
    rows = {
        r.label: r for r in session.scalars(select(LoadStateRow).where(LoadStateRow.campaign_id == row.id))
    }
    for position, state in enumerate(after.states):
        state_row = rows.get(state.label)
        if state_row is None:
            state_row = LoadStateRow(campaign_id=row.id, label=state.label, position=position)
            session.add(state_row)
        recorded_at = state_row.time
        for name, value in described(state).items():
            setattr(state_row, name, value)
        state_row.time = state.time or recorded_at
        rows[state.label] = state_row
    session.flush()
    of_campaign = select(ChannelRow).join(LoadStateRow, LoadStateRow.id == ChannelRow.state_id)
    channels = {
        (channel.state_id, channel.name): channel
        for channel in session.scalars(of_campaign.where(LoadStateRow.campaign_id == row.id))
    }
    for state in after.states:
        for name, value in state.channels.items():
            number = rows[state.label].id
            if (channel := channels.get((number, name))) is None:
                session.add(ChannelRow(state_id=number, name=name, value=value))
            else:
                channel.value = value


def number_of_states(session: Session, numbers: Sequence[int]) -> dict[int, int]:
    """Return how many states each of some campaigns has, which are few enough for one statement."""
    query = (
        select(LoadStateRow.campaign_id, func.count())
        .where(LoadStateRow.campaign_id.in_(numbers))
        .group_by(LoadStateRow.campaign_id)
    )
    return dict(session.execute(query).all())


def refuse_taken_name(session: Session, name: str, *, even_in_case: bool = False) -> None:
    """Raise `Conflict` where there is a campaign of that name, or of one that differs only in case."""
    taken = CampaignRow.name == name
    if even_in_case:
        taken = func.lower(CampaignRow.name) == name.lower()
    there = session.scalar(select(CampaignRow.name).where(taken).limit(1))
    if there is not None:
        but = "" if there == name else f", from which '{name}' differs only in case"
        raise Conflict(
            f"there is a campaign '{there}' already{but}; choose another name or see "
            f"'sms campaign show {there}'"
        )


def campaign_id(session: Session, name: str) -> int:
    """Return the number of a campaign; raise `NotFound` with the names that there are."""
    number = session.scalar(select(CampaignRow.id).where(CampaignRow.name == name))
    if number is None:
        known = session.scalars(select(CampaignRow.name).order_by(CampaignRow.id.desc())).all()
        hint = (
            f"{did_you_mean(name, known)}the latest are {', '.join(known[:5])}"
            if known
            else "there is none yet; see 'sms campaign create --help'"
        )
        raise NotFound(f"there is no campaign '{name}'; {hint}")
    return number


def campaign_row(session: Session, name: str) -> CampaignRow:
    """Return the row of a campaign; raises as `campaign_id` does."""
    return session.get_one(CampaignRow, campaign_id(session, name))


@cache
def _definition() -> TypeAdapter[Campaign]:
    # Scenes and sensors, which nobody who only names campaigns should wait for.
    from sms_jobs.records.campaign import Campaign

    return TypeAdapter(Campaign)


def definition(row: CampaignRow) -> Campaign:
    """Return the `Campaign` record of a row."""
    return _definition().validate_python(row.definition)


def define(row: CampaignRow, campaign: Campaign) -> None:
    """Give a row its definition, or another one."""
    row.definition = as_json(campaign)
    row.views, row.frames = list(campaign.views), campaign.sequence.frames
    row.frame = None if campaign.frame is None else campaign.frame.method
    row.definition_hash = _digest(row.definition)


def definition_hash(campaign: Campaign) -> str:
    """Return by what a row knows the definition that `define` would give it."""
    return _digest(as_json(campaign))


def _digest(kept: dict[str, Any]) -> str:
    canonical = json.dumps(kept, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


class Definitions:
    """The campaigns that jobs or pages were about lately, read and parsed once.

    With hundreds of states that takes longer than everything else that is done for a job, or for a page.
    Threads may share it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._definitions: dict[str, Campaign] = {}

    def get(self, session: Session, campaign_id: int, known_by: str) -> Campaign:
        """Return the definition of a campaign that has that hash; where it has another one now, that."""
        with self._lock:
            known = self._definitions.get(known_by)
        if known is not None:
            return known
        row = session.get_one(CampaignRow, campaign_id, options=[undefer(CampaignRow.definition)])
        campaign = definition(row)
        with self._lock:
            self._definitions[row.definition_hash] = campaign
            if len(self._definitions) > KEPT_DEFINITIONS:
                del self._definitions[next(iter(self._definitions))]
        return campaign


_SHOWN = Definitions()


def shown_definition(session: Session, row: CampaignRow) -> Campaign:
    """Return the definition of a row, parsed once for all in this process who show it."""
    return _SHOWN.get(session, row.id, row.definition_hash)


def as_json(campaign: Campaign) -> dict[str, Any]:
    """Return what a row keeps of a campaign."""
    kept: dict[str, Any] = _definition().dump_python(campaign, mode="json")
    return kept


def state_ids(session: Session, campaign_id: int, labels: Collection[str] | None = None) -> dict[str, int]:
    """Return the ids of a campaign's states, or of some of them, by label."""
    query = select(LoadStateRow.label, LoadStateRow.id).where(LoadStateRow.campaign_id == campaign_id)
    if labels is None:
        return dict(session.execute(query).all())
    found: dict[str, int] = {}
    for some in parts(sorted(labels)):
        found |= dict(session.execute(query.where(LoadStateRow.label.in_(some))).all())
    return found


def refuse_unknown_states(session: Session, campaign: str, labels: Collection[str]) -> None:
    """Raise `NotFound` where a campaign has not all of some states, or is not there itself."""
    number = campaign_id(session, campaign)
    lacking = sorted(set(labels) - state_ids(session, number, labels).keys())
    if lacking:
        meant = did_you_mean(lacking[0], state_ids(session, number))
        raise NotFound(
            f"campaign {campaign} has no state {lacking[0]}; {meant}"
            f"'sms campaign show {campaign}' shows its own"
        )


def rig_row(session: Session, name: str) -> RigRow:
    """Return the row of a rig, a new one where nothing has named the rig yet."""
    rig = session.scalar(select(RigRow).where(RigRow.name == name))
    if rig is None:
        rig = RigRow(name=name)
        session.add(rig)
    return rig
