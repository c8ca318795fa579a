"""Enters a campaign and the calibration of its rig.

A campaign's definition is sealed too, so that a catalogue can be rebuilt from the archive alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import select

from sms_jobs.archive import Archive, InputReference, Provenance, Sealed
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import CalibrationRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.archiving import decisions
from sms_jobs.jobs.archiving.acceptances import decided
from sms_jobs.jobs.archiving.indexing import ACCEPTANCE, CAMPAIGN, calibration_file
from sms_jobs.jobs.archiving.repository import Repository, brought_in
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.products import CALIBRATED, Product
from sms_jobs.records.calibration import NOBODY, Acceptance, Signed
from sms_jobs.records.campaign import Campaign, CampaignDefinition
from sms_jobs.records.subject import RESERVED_NAME, Subject, alike_but_for_case

if TYPE_CHECKING:
    from sms_jobs.records.sensors import Calibration


def register_campaign(
    catalogue: Catalogue,
    archive: Archive,
    campaign: Campaign,
    calibration: Calibration | None,
    now: datetime,
    plan: str | None = None,
) -> None:
    """Add a campaign and, if given, a calibration of its own and the text of the file that defines both.

    Raises
    ------
    Conflict
        There is a campaign of that name, or of one that differs only in case; nothing is changed.
    InvalidInput
        It sets a parameter that its job kind does not take, or declares a gauge outside of the only images
        that it is read from, or two of its states differ only in case; nothing is changed.
    """
    _refuse_alike_states(campaign)
    for name, parameters in campaign.processing.items():
        kind_named(name).checked_parameters(parameters)
    if campaign.processing:
        # Not at the top: those who bring in nothing but calibrations need no kind.
        from sms_jobs.kinds.gauges_in_images import check_declared

        calibrated = None if calibration is None else calibration.rig
        check_declared(campaign, calibrated if campaign.scene is None else campaign.scene.rig)
    with catalogue.reading() as session:
        campaigns.refuse_taken_name(session, campaign.name, even_in_case=True)
    with Repository(catalogue, archive).batch() as batch:
        batch.seal({CAMPAIGN: CampaignDefinition(campaign, plan)}, defined(campaign.name, now))
        if calibration is not None:
            made = batch.seal({CALIBRATION: calibration}, _brought(calibration, now)).sealed
            own = Acceptance(calibration.rig.name, made.content_hash, campaign.name)
            batch.seal({ACCEPTANCE: own}, decided(own, _path(catalogue, made), now))
        batch.enter(lambda session: campaigns.refuse_taken_name(session, campaign.name, even_in_case=True))


def defined(campaign: str, at: datetime) -> Provenance:
    """Return the provenance of what a campaign is."""
    return brought_in(CAMPAIGN, Subject(campaign), at)


@dataclass(frozen=True)
class Registered:
    """A calibration that was brought in.

    Attributes
    ----------
    number
        Of the catalogue.
    new
        False where the catalogue had the same from another file.
    in_use
        Whether it is used for its rig.
    """

    number: int
    new: bool
    in_use: bool


def register_calibration(
    catalogue: Catalogue,
    archive: Archive,
    calibration: Calibration,
    now: datetime,
    *,
    inputs: tuple[InputReference, ...] = (),
    beside: Mapping[Product[Any], Any] | None = None,
    accepted: bool = False,
    signed: Signed = NOBODY,
) -> Registered:
    """Add a calibration of a rig: one that was made elsewhere, or the result of a session.

    The first of a rig is used from the beginning. Any other waits until it is accepted by its number, so that
    nobody's files change what a rig measures.

    Parameters
    ----------
    inputs
        Files that it comes from.
    beside
        Records that are stored with it: its covariance, and what is known of its quality.
    accepted
        Whether it is used for its rig even where that has others.
    signed
        Who brings it in.

    Raises
    ------
    Conflict
        Its rig is known with other sensors; nothing is changed.
    """
    with catalogue.reading() as session:
        decisions.refuse_other_sensors(session, calibration.rig)
        accepted = accepted or not decisions.has_one(session, calibration.rig.name)
    with Repository(catalogue, archive).batch() as batch:
        others = {product.stored_as: record for product, record in (beside or {}).items()}
        records = {CALIBRATED.stored_as: calibration, **others}
        made = batch.seal(records, _brought(calibration, now, inputs)).sealed
        if accepted:
            acceptance = Acceptance(calibration.rig.name, made.content_hash, signed=signed)
            batch.seal({ACCEPTANCE: acceptance}, decided(acceptance, _path(catalogue, made), now))
        kept = batch.enter(lambda session: decisions.refuse_other_sensors(session, calibration.rig))[0]
    with catalogue.reading() as session:
        number = session.scalars(
            select(CalibrationRow.id).where(CalibrationRow.file_id == kept.file_id)
        ).one()
        return Registered(number, kept.new, decisions.is_used(session, number))


def _brought(calibration: Calibration, at: datetime, inputs: tuple[InputReference, ...] = ()) -> Provenance:
    return brought_in(CALIBRATION, Subject(RESERVED_NAME, calibration.rig.name), at, inputs=inputs)


def _path(catalogue: Catalogue, sealed: Sealed) -> str:
    """Return where a calibration lies by which the catalogue knows it: another file may be the same."""
    with catalogue.reading() as session:
        number = calibration_file(session, sealed.content_hash)
        return sealed.path if number is None else session.get_one(FileRow, number).path


def _refuse_alike_states(campaign: Campaign) -> None:
    """Raise `InvalidInput` where two states differ only in case: exports write files by these names."""
    alike = alike_but_for_case(state.label for state in campaign.states)
    if alike is not None:
        raise InvalidInput(
            f"the states {alike[0]} and {alike[1]} of campaign {campaign.name} differ only in case, and many "
            "disks take files of theirs for one; choose another label"
        )
