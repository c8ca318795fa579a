"""Enters a campaign and the calibration of its rig: sealed first, then indexed, or neither.

A campaign's definition is sealed too, so that a catalogue can be rebuilt from the archive alone.
"""

from __future__ import annotations

import getpass
import socket
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs.archive import Archive, InputReference, Sealed
from sms_jobs.catalogue import campaigns, lineage
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import CalibrationRow, FileRow, ProvenanceRow
from sms_jobs.errors import Conflict
from sms_jobs.jobs.planning import checked_parameters
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import CALIBRATION
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
    """Add a campaign and, if given, the calibration of its rig and the text of the file that defines both.

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
    definition = seal_definition(archive, CampaignDefinition(campaign, plan), now)
    try:
        sealed = None if calibration is None else _seal(archive, calibration, now)
    except BaseException:
        archive.discard(definition.path)
        raise
    try:
        with catalogue.writing() as session:
            campaigns.add_campaign(session, campaign, now, plan)
            index_definition(session, campaign.name, definition, now)
            if calibration is not None and sealed is not None:
                _index(session, archive, calibration, sealed, now)
    except Conflict:
        # Somebody else was faster with the same name.
        archive.discard(definition.path)
        if sealed is not None:
            archive.discard(sealed.path)
        raise


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
    file = FileRow(
        source=CAMPAIGN,
        path=sealed.path,
        content_hash=sealed.content_hash,
        size_bytes=sealed.size_bytes,
        sha256=sealed.sha256,
        media_type=sealed.media_type,
        created_at=now,
        campaign_id=campaigns.campaign_id(session, name),
    )
    session.add(file)
    session.flush()
    return file.id


def register_calibration(
    catalogue: Catalogue,
    archive: Archive,
    calibration: Calibration,
    now: datetime,
    *,
    inputs: tuple[InputReference, ...] = (),
    beside: Mapping[str, Any] | None = None,
) -> tuple[int, bool]:
    """Add a calibration of a rig: one that was made elsewhere, or the result of a session.

    Parameters
    ----------
    inputs
        Files that it comes from.
    beside
        Records that are stored with it: its covariance, and what is known of its quality.

    Returns
    -------
    Its number in the catalogue, and whether it is new: the same calibration is entered once.
    """
    sealed = _seal(archive, calibration, now, inputs, beside)
    try:
        with catalogue.writing() as session:
            number = _index(session, archive, calibration, sealed, now, inputs)
            path = session.scalar(
                select(FileRow.path)
                .join(CalibrationRow, CalibrationRow.file_id == FileRow.id)
                .where(CalibrationRow.id == number)
            )
    except BaseException:
        archive.discard(sealed.path)
        raise
    return number, path == sealed.path


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


def _index(
    session: Session,
    archive: Archive,
    calibration: Calibration,
    sealed: Sealed,
    now: datetime,
    inputs: tuple[InputReference, ...] = (),
) -> int:
    """Index a sealed calibration and return its number; the file of one that is known is discarded."""
    same = session.scalar(
        select(CalibrationRow.id)
        .join(FileRow, FileRow.id == CalibrationRow.file_id)
        .where(FileRow.source == CALIBRATION, FileRow.content_hash == sealed.content_hash)
    )
    if same is not None:
        archive.discard(sealed.path)
        return same
    file = FileRow(
        source=CALIBRATION,
        path=sealed.path,
        content_hash=sealed.content_hash,
        size_bytes=sealed.size_bytes,
        sha256=sealed.sha256,
        media_type=sealed.media_type,
        created_at=now,
    )
    session.add(file)
    session.flush()
    for given in inputs:
        source = session.scalars(select(FileRow.id).where(FileRow.path == given.path)).one()
        session.add(ProvenanceRow(output_id=file.id, role=given.role, input_id=source))
    lineage.note_calibrations(session, file.id)
    lineage.note_recordings(session, file)
    return campaigns.add_calibration(session, calibration, file.id)
