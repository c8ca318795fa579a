"""Which calibrations are used: decisions of people, sealed beside the calibrations, then indexed.

A calibration that a plan or a portable folder brings is used for its campaign alone; one that a session gave
and somebody certified, or the first of a rig, for the whole rig; any other not before it is accepted.
"""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, InputReference, Provenance
from sms_jobs.catalogue import campaigns, search
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import AcceptanceRow
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.archiving import decisions
from sms_jobs.jobs.archiving.indexing import ACCEPTANCE
from sms_jobs.jobs.archiving.repository import Repository, brought_in
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.calibration import Acceptance
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
) -> bool:
    """Decide that a calibration is used from now on, or no longer: for its rig, or for one campaign alone.

    Parameters
    ----------
    number
        Of the calibration.
    campaign
        Name of the campaign; None for the rig.

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
        acceptance = Acceptance(view.rig, view.content_hash, campaign, in_use)
        if decisions.is_made(session, acceptance):
            return False
        last = session.get(AcceptanceRow, (number, campaign or ""))
        if last is not None:
            # A clock that was set back must not make the earlier decision the later one.
            now = max(now, last.decided_at + timedelta(microseconds=1))
    provenance = decided(acceptance, view.path, now)
    return Repository(catalogue, archive).put({ACCEPTANCE: acceptance}, provenance).new


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
