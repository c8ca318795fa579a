"""Homes with a campaign in them, and results that no job has made."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from sms_jobs import bootstrap
from sms_jobs.archive import Provenance
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate
from support.catalogues import migrated_file

WHEN = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
"""When the first stored result was made."""


@cache
def _migrated() -> bytes:
    with TemporaryDirectory() as folder:
        return migrated_file(Path(folder)).read_bytes()


def initialised(home: Path) -> None:
    """Make a home with a file as its catalogue, as `bootstrap.initialise` does it.

    The newest schema is there before: migrating takes twenty times as long as all the rest.
    """
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    catalogue = home / "catalogue.sqlite"
    if not catalogue.exists():
        catalogue.write_bytes(_migrated())
    bootstrap.initialise(home)


def make_home(home: Path, environment: Mapping[str, str], campaign: str = "plate") -> None:
    """Make a home with the small virtual plate in it."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        (bootstrap.initialise if "SMS_DATABASE_URL" in environment else initialised)(home)
        with bootstrap.services(home) as services:
            calibration, record = small_plate(campaign)
            register_campaign(services.catalogue, services.archive, record, calibration, datetime.now(UTC))


def stored(
    services: Services, kind: str, subject: str, records: dict[str, Any] | None, number: int = 0
) -> int:
    """Seal and enter what a job would have made: records, or a text document."""
    about = Subject.parse(subject)
    made = Provenance(
        kind, 1, about, f"{number:032x}", 1, WHEN + timedelta(seconds=number), {}, (), "0.1", "h", "me"
    )
    if records is None:
        sealed = services.archive.seal_document(
            "page.html", "text/html", lambda path: path.write_text("<p>page</p>") and None, made
        )
    else:
        sealed = services.archive.seal_dataset(records, made)
    with services.catalogue.writing() as session:
        campaign = campaigns.campaign_row(session, about.campaign)
        states = campaigns.state_ids(session, campaign.id)
        row = FileRow(
            source=kind,
            path=sealed.path,
            content_hash=sealed.content_hash,
            size_bytes=sealed.size_bytes,
            sha256=sealed.sha256,
            media_type=sealed.media_type,
            created_at=made.created_at,
            campaign_id=campaign.id,
            state_id=states[about.state] if about.state else None,
            view=about.view,
        )
        session.add(row)
        session.flush()
        return row.id
