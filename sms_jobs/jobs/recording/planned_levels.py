"""Plans that give a campaign one more state at each load that is held: one row of the catalogue for each.

States are added by `reached_levels`; here the plan is made, held and forgotten.
"""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime
from typing import NamedTuple

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow
from sms_jobs.catalogue.tables.files import FileRow, ReadingRow
from sms_jobs.catalogue.tables.planned import PlannedLevelsRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.gauge_limits import Look
from sms_jobs.records.levels import Levels, next_label
from sms_jobs.records.units import in_unit_of_name


class PlannedLevels(NamedTuple):
    """A row, and what it is about."""

    row: PlannedLevelsRow
    campaign: str
    rig: str

    @property
    def levels(self) -> Levels:
        """At which loads a state is added."""
        row = self.row
        return Levels(row.channel, row.unit, row.step, row.tolerance, row.for_s)


def planned_levels(session: Session, campaigns: Collection[int] | None = None) -> list[PlannedLevels]:
    """Return the rows of some campaigns, few enough for one statement, or of all."""
    query = (
        select(PlannedLevelsRow, CampaignRow.name, RigRow.name)
        .join(CampaignRow, CampaignRow.id == PlannedLevelsRow.campaign_id)
        .join(RigRow, RigRow.id == CampaignRow.rig_id)
        .order_by(PlannedLevelsRow.campaign_id)
    )
    if campaigns is not None:
        query = query.where(PlannedLevelsRow.campaign_id.in_(campaigns))
    return [PlannedLevels(*row) for row in session.execute(query)]


def put(
    session: Session,
    campaign: int,
    levels: Levels,
    by: str,
    now: datetime,
    *,
    ask: bool,
    process: bool,
    look: Look,
) -> None:
    """Plan one more state of a campaign at each level that is held, in the place of what was planned so.

    The campaign is locked. Where the levels stay the same ones, so does the one that was recorded last.

    Parameters
    ----------
    by
        Who plans it.
    ask, process, look
        Of each recording, see `planned_recordings.put`.
    """
    row = session.get(PlannedLevelsRow, campaign)
    if row is None:
        row = PlannedLevelsRow(campaign_id=campaign, revision=-1, last_file_id=0)
        session.add(row)
    elif (row.channel, row.unit, row.step) != (levels.channel, levels.unit, levels.step):
        row.last, row.last_state_id, row.last_file_id = None, None, 0
    row.channel, row.unit, row.step = levels.channel, levels.unit, levels.step
    row.tolerance, row.for_s = levels.tolerance, levels.for_s
    row.ask, row.process, row.look = ask, process, look.enabled
    row.stop_if = [limit.as_json() for limit in look.stop_if]
    row.held, row.revision = False, row.revision + 1
    row.planned_at, row.planned_by = now, by
    row.seen, row.seen_at, row.note = None, None, None
    session.flush()


def set_held(session: Session, campaign: int, held: bool) -> list[str]:
    """Hold the levels of a campaign back, or let them go on; return the next state where that is new."""
    changed = session.scalar(
        update(PlannedLevelsRow)
        .where(PlannedLevelsRow.campaign_id == campaign, PlannedLevelsRow.held.is_(not held))
        .values(held=held)
        .returning(PlannedLevelsRow.campaign_id)
        .execution_options(synchronize_session=False)
    )
    return [] if changed is None else [next_state(session, campaign)]


def drop(session: Session, campaign: int) -> list[str]:
    """Forget the levels of a campaign, and return the state that would have been the next."""
    row = session.get(PlannedLevelsRow, campaign)
    if row is None:
        return []
    session.delete(row)
    return [next_state(session, campaign)]


def are_there(session: Session, campaign: int) -> bool:
    """Say whether levels of a campaign are planned."""
    return session.get(PlannedLevelsRow, campaign) is not None


def next_state(session: Session, campaign: int) -> str:
    """Return the label that the next state of a campaign will have."""
    labels = select(LoadStateRow.label).where(LoadStateRow.campaign_id == campaign)
    return next_label(session.scalars(labels.order_by(LoadStateRow.position)).all())


def last_level(session: Session, one: PlannedLevels) -> float | None:
    """Return the level that was recorded last; None where there is none, or the test was elsewhere since.

    A measurement that came later, by another plan or by hand, tells it by what the channel read meanwhile.
    That of the state that was added last is known by its level, whatever the load did while it was recorded.
    """
    row = one.row
    newest = newest_measurement(session, row.campaign_id)
    if newest <= row.last_file_id:
        return row.last
    if session.get_one(FileRow, newest).state_id == row.last_state_id:
        return row.last
    read = session.scalar(
        select(ReadingRow.value).where(ReadingRow.file_id == newest, ReadingRow.name == row.channel)
    )
    return None if read is None else one.levels.near(read / in_unit_of_name(row.channel, 1.0, row.unit))


def newest_measurement(session: Session, campaign: int) -> int:
    """Return the file of the newest measurement of a campaign; 0 where there is none."""
    of_campaign = FileRow.campaign_id == campaign, FileRow.source == MEASUREMENT
    return session.scalar(select(func.max(FileRow.id)).where(*of_campaign)) or 0


def note_reading(session: Session, campaign: int, seen: float | None, now: datetime) -> None:
    """Note what the channel read just now, and that nothing keeps it from that."""
    _set(session, campaign, seen=seen, seen_at=now, note=None)


def note(session: Session, campaign: int, words: str) -> None:
    """Note what keeps the channel from being watched, or a state from being added."""
    _set(session, campaign, note=words)


def _set(session: Session, campaign: int, **values: object) -> None:
    session.execute(update(PlannedLevelsRow).where(PlannedLevelsRow.campaign_id == campaign).values(**values))
