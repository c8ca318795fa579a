"""Which calibrations are used: decisions of people, sealed beside the calibrations, then indexed.

A calibration that a plan or a portable folder brings is used for its campaign alone; one that a session gave
and somebody certified, or the first of a rig, for the whole rig; any other not before it is accepted.
"""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, InputReference, Provenance
from sms_jobs.catalogue import campaigns, search
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.archiving import decisions
from sms_jobs.jobs.archiving.indexing import ACCEPTANCE
from sms_jobs.jobs.archiving.repository import Repository, brought_in
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.calibration import NOBODY, Acceptance, Signed
from sms_jobs.records.shown.files import DecisionView
from sms_jobs.records.subject import RESERVED_NAME, Subject


def decided(acceptance: Acceptance, path: str, at: datetime) -> Provenance:
    """Return the provenance of a decision about the calibration that lies at a path."""
    about = InputReference(CALIBRATION, CALIBRATION, path, acceptance.calibration)
    return brought_in(ACCEPTANCE, Subject(RESERVED_NAME, acceptance.rig), at, inputs=(about,))


def accept(
    catalogue: Catalogue,
    archive: Archive,
    number: int,
    campaign: str | None,
    now: datetime,
    *,
    in_use: bool = True,
    signed: Signed = NOBODY,
) -> bool:
    """Decide that a calibration is used from now on, or no longer: for its rig, or for one campaign alone.

    Parameters
    ----------
    number
        Of the calibration.
    campaign
        Name of the campaign; None for the rig.
    signed
        Who decides it.

    Returns
    -------
    False where it was decided so before.

    Raises
    ------
    NotFound
        There is no such calibration or campaign.
    Conflict
        The rig or the campaign has other sensors.
    """
    with catalogue.reading() as session:
        view = search.calibration_view(session, number)
        if campaign is not None:
            _refuse_other_rig(session, view.rig, campaign, number)
        acceptance = Acceptance(view.rig, view.content_hash, campaign, in_use, signed)
        if decisions.is_made(session, acceptance):
            return False
        last = session.get(AcceptanceRow, (number, campaign or ""))
        if last is not None:
            # A clock that was set back must not make the earlier decision the later one.
            now = max(now, last.decided_at + timedelta(microseconds=1))
    provenance = decided(acceptance, view.path, now)
    return Repository(catalogue, archive).put({ACCEPTANCE: acceptance}, provenance).new


def about(catalogue: Catalogue, archive: Archive, number: int) -> list[DecisionView]:
    """Return what was decided last about a calibration, for its rig and for each campaign, by time."""
    with catalogue.reading() as session:
        rows = session.execute(
            select(AcceptanceRow.decided_at, AcceptanceRow.file_id)
            .where(AcceptanceRow.calibration_id == number)
            .order_by(AcceptanceRow.decided_at)
        ).all()
        files = [(at, search.file_view(session, str(file_id))) for at, file_id in rows]
    found = []
    for at, file in files:
        with archive.open(file) as dataset:
            made = dataset.read(ACCEPTANCE, Acceptance)
        found.append(DecisionView(at, made.campaign, made.in_use, made.signed.by, made.signed.reason))
    return found


def _refuse_other_rig(session: Session, rig: str, campaign: str, number: int) -> None:
    theirs = campaigns.definition(campaigns.campaign_row(session, campaign)).rig
    if theirs != rig:
        raise InvalidInput(
            f"calibration {number} is of rig {rig}, and campaign {campaign} is measured by rig {theirs}; "
            f"'sms calibration list' shows those of {theirs}"
        )


def read(archive: Archive, path: str) -> Acceptance:
    """Read a sealed decision that is not on record yet."""
    with archive.open_unrecorded(path) as dataset:
        return dataset.read(ACCEPTANCE, Acceptance)
