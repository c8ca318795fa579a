"""What the catalogue makes of a decision whether a calibration is used, and which it refuses."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, valid_calibrations
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow, CalibrationRow
from sms_jobs.catalogue.tables.campaigns import RigRow
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow
from sms_jobs.catalogue.valid_calibrations import Sensors
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.views import role_of, view_of

if TYPE_CHECKING:
    from sms_jobs.records.calibration import Acceptance
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.sensors import Rig


def decide(session: Session, acceptance: Acceptance, at: datetime, file_id: int) -> None:
    """Make a decision count whose file is in the catalogue.

    Raises
    ------
    Conflict
        The rig or the campaign has other sensors.
    InvalidInput
        The catalogue does not know the calibration.
    NotFound
        It does not know the campaign.
    """
    row = _calibration(session, acceptance)
    if row is None:
        raise InvalidInput(
            f"the calibration of rig {acceptance.rig} with the contents {acceptance.calibration[:12]}... is "
            "not in the catalogue: bring it in, then reindex again"
        )
    if acceptance.in_use:
        what = f"calibration {row.id} of rig {acceptance.rig}"
        if acceptance.campaign is None:
            _refuse_other_than_rig(session, row.sensors, row.rig_id, what)
        else:
            _refuse_other_than_campaign(session, row.sensors, acceptance.campaign, what)
    valid_calibrations.decide(session, row.id, acceptance, at, file_id)
    session.add(ProvenanceRow(output_id=file_id, role=CALIBRATION, input_id=row.file_id))


def is_made(session: Session, acceptance: Acceptance) -> bool:
    """Say whether a calibration is used, or not, as a decision wants it."""
    row = _calibration(session, acceptance)
    return row is not None and is_used(session, row.id, acceptance.campaign or "") == acceptance.in_use


def _calibration(session: Session, acceptance: Acceptance) -> CalibrationRow | None:
    return session.scalar(
        select(CalibrationRow)
        .join(FileRow, FileRow.id == CalibrationRow.file_id)
        .join(RigRow, RigRow.id == CalibrationRow.rig_id)
        .where(
            FileRow.source == CALIBRATION,
            FileRow.content_hash == acceptance.calibration,
            RigRow.name == acceptance.rig,
        )
    )


def has_one(session: Session, rig: str) -> bool:
    """Say whether a rig has a calibration that is used for all of its campaigns."""
    row = session.scalar(select(RigRow).where(RigRow.name == rig))
    return row is not None and bool(valid_calibrations.used_for_rig(session, row.id))


def is_used(session: Session, number: int, campaign: str = "") -> bool:
    """Say whether a calibration is used for its rig, or for a campaign alone."""
    row = session.get(AcceptanceRow, (number, campaign))
    return row is not None and row.in_use


def refuse_other_sensors(session: Session, rig: Rig) -> None:
    """Raise `Conflict` where a rig is known with other sensors than these."""
    row = session.scalar(select(RigRow).where(RigRow.name == rig.name))
    if row is not None:
        what = f"the calibration of rig {rig.name}"
        _refuse_other_than_rig(session, valid_calibrations.sensors_of(rig), row.id, what)


def _refuse_other_than_rig(session: Session, sensors: Sensors, rig_id: int, what: str) -> None:
    for used in valid_calibrations.used_for_rig(session, rig_id):
        if used.sensors != sensors:
            raise Conflict(
                f"{what} is of {_named(sensors)}, and calibration {used.number}, which is in use for that "
                f"rig, of {_named(used.sensors)}: a rig with other sensors needs a name of its own"
            )


def _refuse_other_than_campaign(session: Session, sensors: Sensors, name: str, what: str) -> None:
    stated = _sensors_of(campaigns.definition(campaigns.campaign_row(session, name)))
    other = {n: s for n, s in stated.items() if any(sensors.get(n, {}).get(k) != v for k, v in s.items())}
    if other:
        raise Conflict(
            f"{what} is of {_named(sensors)}, and campaign {name} is measured by {_named(other)}: choose a "
            "calibration of its sensors; see 'sms calibration list'"
        )


def _sensors_of(campaign: Campaign) -> Sensors:
    """Return what a campaign says of the sensors that have to be calibrated.

    Of a virtual rig all that is known of them, of others what their names tell.
    """
    names = dict.fromkeys(name for view in campaign.views for name in view_of(view).triangulating)
    if campaign.scene is not None:
        sensors = valid_calibrations.sensors_of(campaign.scene.rig)
        return {name: sensors[name] for name in names}
    sensors = {n: {"role": role_of(n).value} for n in names}
    sizes = () if campaign.session is None else campaign.session.sensors
    return sensors | {
        s.name: {**sensors.get(s.name, {}), "columns": s.columns, "rows": s.rows} for s in sizes
    }


def _named(sensors: Sensors) -> str:
    return ", ".join(
        f"{name} ({sensor['columns']} x {sensor['rows']} px)" if "columns" in sensor else name
        for name, sensor in sensors.items()
    )
