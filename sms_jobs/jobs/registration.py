"""Enters a campaign and the calibration of its rig: sealed first, then indexed, or neither.

A campaign's definition is sealed too, so that a catalogue can be rebuilt from the archive alone.
"""

from __future__ import annotations

import getpass
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs.archive import Archive, InputReference, Sealed
from sms_jobs.catalogue import campaigns, lineage, valid_calibrations
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import CalibrationRow, FileRow, ProvenanceRow
from sms_jobs.jobs import acceptances
from sms_jobs.jobs.entering import enter_file, entered_or_discarded
from sms_jobs.jobs.planning import checked_parameters
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.calibration import Acceptance
from sms_jobs.records.campaign import Campaign, CampaignDefinition
from sms_jobs.records.sensors import Calibration

CAMPAIGN = "campaign"
"""The source of files that define campaigns."""


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
        There is a campaign of that name; nothing is changed.
    InvalidInput
        It sets a parameter that its job kind does not take; nothing is changed.
    """
    for name, parameters in campaign.processing.items():
        checked_parameters(kind_named(name), parameters)
    with catalogue.reading() as session:
        campaigns.refuse_taken_name(session, campaign.name)
    with entered_or_discarded(archive) as sealed:
        sealed.append(seal_definition(archive, CampaignDefinition(campaign, plan), now))
        if calibration is not None:
            sealed.append(_seal(archive, calibration, now))
            own = Acceptance(calibration.rig.name, sealed[-1].content_hash, campaign.name)
            sealed.append(acceptances.seal(archive, own, _path(catalogue, sealed[-1]), now))
        with catalogue.writing() as session:
            campaigns.add_campaign(session, campaign, now, plan)
            index_definition(session, campaign.name, sealed[0], now)
            if calibration is not None:
                _, same = _index(session, calibration, sealed[1], now)
                acceptances.enter(session, own, sealed[2], now)
    if calibration is not None and same:
        archive.discard(sealed[1].path)


def seal_definition(archive: Archive, definition: CampaignDefinition, now: datetime) -> Sealed:
    """Store in the archive what a campaign is."""
    return archive.seal_campaign(
        definition,
        now,
        program_version=sms_jobs.__version__,
        host=socket.gethostname(),
        operator=getpass.getuser(),
    )


def index_definition(session: Session, name: str, sealed: Sealed, now: datetime) -> int:
    """Index the sealed definition of a campaign that the catalogue knows; return the number of the file."""
    number = campaigns.campaign_id(session, name)
    return enter_file(session, sealed, CAMPAIGN, now, campaign_id=number).id


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
    beside: Mapping[str, Any] | None = None,
    accepted: bool = False,
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

    Raises
    ------
    Conflict
        Its rig is known with other sensors; nothing is changed.
    """
    with catalogue.reading() as session:
        acceptances.refuse_other_sensors(session, calibration.rig)
        accepted = accepted or not acceptances.has_one(session, calibration.rig.name)
    with entered_or_discarded(archive) as sealed:
        sealed.append(_seal(archive, calibration, now, inputs, beside))
        acceptance = Acceptance(calibration.rig.name, sealed[0].content_hash)
        if accepted:
            sealed.append(acceptances.seal(archive, acceptance, _path(catalogue, sealed[0]), now))
        with catalogue.writing() as session:
            acceptances.refuse_other_sensors(session, calibration.rig)
            number, same = _index(session, calibration, sealed[0], now, inputs)
            in_use = acceptances.is_used(session, number)
            again = accepted and in_use
            if accepted and not in_use:
                acceptances.enter(session, acceptance, sealed[1], now)
    for file in (*sealed[:1] * same, *sealed[1:] * again):
        archive.discard(file.path)
    return Registered(number, not same, accepted or in_use)


def _seal(
    archive: Archive,
    calibration: Calibration,
    now: datetime,
    inputs: tuple[InputReference, ...] = (),
    beside: Mapping[str, Any] | None = None,
) -> Sealed:
    return archive.seal_calibration(
        calibration,
        now,
        program_version=sms_jobs.__version__,
        host=socket.gethostname(),
        operator=getpass.getuser(),
        inputs=inputs,
        beside=beside,
    )


def _path(catalogue: Catalogue, sealed: Sealed) -> str:
    """Return where a calibration lies by which the catalogue knows it: another file may be the same."""
    query = select(FileRow.path).where(
        FileRow.source == CALIBRATION, FileRow.content_hash == sealed.content_hash
    )
    with catalogue.reading() as session:
        return session.scalar(query) or sealed.path


def _index(
    session: Session,
    calibration: Calibration,
    sealed: Sealed,
    now: datetime,
    inputs: tuple[InputReference, ...] = (),
) -> tuple[int, bool]:
    """Index a sealed calibration; return its number, and whether another file of the same has it already."""
    known = session.scalar(
        select(CalibrationRow.id)
        .join(FileRow, FileRow.id == CalibrationRow.file_id)
        .where(FileRow.source == CALIBRATION, FileRow.content_hash == sealed.content_hash)
    )
    if known is not None:
        return known, True
    file = enter_file(session, sealed, CALIBRATION, now)
    for given in inputs:
        source = session.scalars(select(FileRow.id).where(FileRow.path == given.path)).one()
        session.add(ProvenanceRow(output_id=file.id, role=given.role, input_id=source))
    lineage.note_calibrations(session, file.id)
    lineage.note_recordings(session, file)
    return valid_calibrations.add_calibration(session, calibration, file.id), False
