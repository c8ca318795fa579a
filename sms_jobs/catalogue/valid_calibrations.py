"""Which calibrations are used, and which of them holds for what was measured."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import changes
from sms_jobs.catalogue.campaigns import rig_row
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow, CalibrationRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow, ProvenanceRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.records.shown.changes import Followed
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED

if TYPE_CHECKING:
    from sms_jobs.records.calibration import Acceptance
    from sms_jobs.records.sensors import Calibration, Rig

Sensors = Mapping[str, Mapping[str, Any]]
"""Role, columns and rows of sensors, by name."""

_OF_THE_RIG = ""


@dataclass(frozen=True)
class UsedCalibration:
    """A calibration that is used for a campaign, from a time on."""

    number: int
    file_id: int
    valid_from: datetime
    sensors: Sensors


def sensors_of(rig: Rig) -> dict[str, dict[str, Any]]:
    """Return what the catalogue keeps of the sensors of a calibration."""
    return {s.name: {"role": s.role.value, "columns": s.columns, "rows": s.rows} for s in rig.sensors}


def add_calibration(session: Session, calibration: Calibration, file_id: int) -> int:
    """Index a calibration file, which nobody has accepted yet; return the number of the calibration."""
    rig = rig_row(session, calibration.rig.name)
    session.flush()
    row = CalibrationRow(
        rig_id=rig.id,
        file_id=file_id,
        valid_from=calibration.valid_from,
        origin=calibration.origin,
        sensors=sensors_of(calibration.rig),
    )
    session.add(row)
    session.flush()
    changes.enter(session, Followed.CALIBRATION, str(row.id), "", "entered", f"of rig {calibration.rig.name}")
    return row.id


def decide(session: Session, number: int, acceptance: Acceptance, at: datetime, file_id: int) -> None:
    """Enter a decision about a calibration, unless a later one is known."""
    campaign = acceptance.campaign or _OF_THE_RIG
    row = session.get(AcceptanceRow, (number, campaign))
    if row is None:
        row = AcceptanceRow(calibration_id=number, campaign=campaign)
        session.add(row)
    elif row.decided_at > at:
        return
    row.in_use, row.decided_at, row.file_id = acceptance.in_use, at, file_id
    became = "accepted" if acceptance.in_use else "withdrawn"
    whose = f"for campaign {campaign}" if campaign else f"for rig {acceptance.rig}"
    changes.enter(session, Followed.CALIBRATION, str(number), campaign, became, whose)
    session.flush()


def used_for_rig(session: Session, rig_id: int) -> tuple[UsedCalibration, ...]:
    """Return the calibrations that are used for a rig, the one that becomes valid first before the others."""
    return tuple(used for *_, used in _used(session, AcceptanceRow.campaign == _OF_THE_RIG, [rig_id]))


def used_for_rig_named(session: Session, name: str) -> tuple[UsedCalibration, ...]:
    """Return the calibrations that are used for a rig; none where nothing has named it yet."""
    rig_id = session.scalar(select(RigRow.id).where(RigRow.name == name))
    return () if rig_id is None else used_for_rig(session, rig_id)


def used_for_campaign(session: Session, campaign_id: int) -> tuple[UsedCalibration, ...]:
    """Return the calibrations that are used for a campaign: its own where it has any, else those of its rig.

    What a calibration session gave is not among those that it begins with itself.
    """
    return used_for_campaigns(session, [campaign_id])[campaign_id]


def used_for_campaigns(session: Session, numbers: Sequence[int]) -> dict[int, tuple[UsedCalibration, ...]]:
    """Return the calibrations that are used for each of some campaigns, few enough for one statement."""
    # Every job asks this: not the whole definition, which takes longer to read than everything else.
    rows = session.execute(
        select(CampaignRow.id, CampaignRow.name, CampaignRow.rig_id).where(CampaignRow.id.in_(numbers))
    ).all()
    names, rigs = {row.name for row in rows} | {_OF_THE_RIG}, {row.rig_id for row in rows}
    accepted: dict[tuple[int, str], list[UsedCalibration]] = defaultdict(list)
    for rig_id, name, used in _used(session, AcceptanceRow.campaign.in_(names), rigs):
        accepted[rig_id, name].append(used)
    files = {used.file_id for some in accepted.values() for used in some}
    given = _given(session, files, numbers)
    found = {}
    for number, name, rig_id in rows:
        own, of_rig = (
            tuple(used for used in accepted.get((rig_id, of), ()) if (used.file_id, number) not in given)
            for of in (name, _OF_THE_RIG)
        )
        found[number] = own or of_rig
    return found


def _given(session: Session, files: Collection[int], campaigns: Sequence[int]) -> set[tuple[int, int | None]]:
    """Return which of some calibration files were computed from files of which campaign."""
    found: set[tuple[int, int | None]] = set()
    for some in parts(sorted(files)):
        query = (
            select(ProvenanceRow.output_id, FileRow.campaign_id)
            .join(FileRow, FileRow.id == ProvenanceRow.input_id)
            .where(ProvenanceRow.output_id.in_(some), FileRow.campaign_id.in_(campaigns))
        )
        found |= {(file, campaign) for file, campaign in session.execute(query)}
    return found


def _used(
    session: Session, accepted: ColumnElement[bool], rigs: Collection[int]
) -> list[tuple[int, str, UsedCalibration]]:
    rows = session.execute(
        select(
            CalibrationRow.rig_id,
            AcceptanceRow.campaign,
            CalibrationRow.id,
            CalibrationRow.file_id,
            CalibrationRow.valid_from,
            CalibrationRow.sensors,
        )
        .join(CalibrationRow, CalibrationRow.id == AcceptanceRow.calibration_id)
        .where(AcceptanceRow.in_use, accepted, CalibrationRow.rig_id.in_(rigs))
        .order_by(CalibrationRow.valid_from, CalibrationRow.id)
    )
    return [(row[0], row[1], UsedCalibration(*row[2:])) for row in rows]


class ValidCalibrations:
    """Tells which calibration holds for what a campaign measured: it is chosen by when that was measured.

    Parameters
    ----------
    campaign_id
        Number of the campaign.
    now
        Stands for the time of what is not measured yet.
    state
        Label of the only state that will be asked for, if it is one.
    """

    def __init__(self, session: Session, campaign_id: int, now: datetime, state: str | None = None) -> None:
        self.used = used_for_campaign(session, campaign_id)
        self._measured = _measured(session, campaign_id, state)
        self._planned = state_times(session, campaign_id, state)
        self._now = now

    def time_of(self, subject: Subject) -> datetime:
        """Return when a subject was measured: of a state, or of a whole campaign, when that began.

        Where nothing is measured yet, it is the time that the plan says, or now.
        """
        if subject.state is not None and subject.view is not None:
            # Of several cameras: they record at one time, and the reference's image stands for all.
            recorded = subject.recordings[0].view or subject.view
            measured = self._measured.get((subject.state, recorded))
            return measured or self._planned.get(subject.state) or self._now
        times = [t for (label, _), t in self._measured.items() if subject.state in (None, label)]
        planned = [t for label, t in self._planned.items() if subject.state in (None, label)]
        return min(times or planned, default=self._now)

    def of(self, subject: Subject) -> UsedCalibration | None:
        """Return the calibration that holds for a subject: the last to become valid before its time."""
        at = self.time_of(subject)
        return next((used for used in reversed(self.used) if used.valid_from <= at), None)


def _measured(session: Session, campaign_id: int, state: str | None) -> dict[tuple[str, str], datetime]:
    """Return when the newest measurement of each tuple was made, by label and view.

    One that was simulated without a time counts as made when it was entered: that does not change either.
    """
    query = (
        select(
            LoadStateRow.label,
            MeasurementRow.view,
            MeasurementRow.recorded_at,
            LoadStateRow.time,
            FileRow.created_at,
        )
        .join(MeasurementRow, MeasurementRow.state_id == LoadStateRow.id)
        .join(FileRow, FileRow.id == MeasurementRow.file_id)
        .where(LoadStateRow.campaign_id == campaign_id)
        .order_by(FileRow.id)
    )
    if state is not None:
        query = query.where(LoadStateRow.label == state)
    return {
        (label, view): recorded if recorded != UNTIMED else planned or entered
        for label, view, recorded, planned, entered in session.execute(query)
    }


def state_times(session: Session, campaign_id: int, state: str | None = None) -> dict[str, datetime]:
    """Return when the states of a campaign were held, by label, where that is planned or already known."""
    query = select(LoadStateRow.label, LoadStateRow.time).where(
        LoadStateRow.campaign_id == campaign_id, LoadStateRow.time.is_not(None)
    )
    if state is not None:
        query = query.where(LoadStateRow.label == state)
    return {label: time for label, time in session.execute(query) if time is not None}


def session_began(session: Session, campaign_id: int) -> datetime | None:
    """Return when the first measurement of a campaign was recorded; None where no time is known."""
    return session.scalar(
        select(func.min(MeasurementRow.recorded_at))
        .join(LoadStateRow, LoadStateRow.id == MeasurementRow.state_id)
        .where(LoadStateRow.campaign_id == campaign_id, MeasurementRow.recorded_at != UNTIMED)
    )


def note_time(session: Session, state_id: int, recorded_at: datetime) -> None:
    """Give a state the time at which it was first recorded, unless it has one."""
    state = session.get_one(LoadStateRow, state_id)
    if state.time is None and recorded_at != UNTIMED:
        state.time = recorded_at
