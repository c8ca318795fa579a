"""What campaigns were, as the archive tells it: a test is given states and readings while it goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, Checker, Found, Provenance, layout
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving.importing import continues
from sms_jobs.jobs.archiving.indexing import CAMPAIGN
from sms_jobs.records.campaign import Campaign, CampaignDefinition


@dataclass(frozen=True)
class Definition:
    """What a campaign was from a time on, and the file that says so."""

    path: str
    since: datetime
    campaign: Campaign


class PastDefinitions:
    """The definitions of campaigns that are entered into a catalogue, or would be.

    Parameters
    ----------
    archive, checker
        Where they lie, and what reads them.
    paths
        All definitions of the archive, by campaign, in the order of their time.
    """

    def __init__(self, archive: Archive, checker: Checker, paths: Mapping[str, Sequence[str]]) -> None:
        self._archive = archive
        self._checker = checker
        self._paths = paths
        self._latest: dict[str, Definition | None] = {}
        self._entered: dict[str, list[Definition]] = {}

    def objection(self, session: Session, one: Found) -> str | None:
        """Say why a definition is not to be entered; None where it is."""
        name, path = one.provenance.subject.campaign, one.sealed.path
        mine = self._read(path, one.provenance.created_at)
        latest = self._latest_of(name)
        if latest is not None and latest.path != path and not continues(mine.campaign, latest.campaign):
            return f"campaign {name} has a later definition in the archive, which is of another test"
        row = _row(session, name)
        if row is not None:
            theirs = campaigns.definition(row)
            if not continues(theirs, mine.campaign) and not continues(mine.campaign, theirs):
                return f"the catalogue has another campaign {name}; only one of them can have the name"
            same = select(FileRow.id).where(
                FileRow.campaign_id == row.id,
                FileRow.source == CAMPAIGN,
                FileRow.content_hash == one.sealed.content_hash,
            )
            if session.scalar(same) is not None:
                return f"campaign {name} has its definition in another file"
        entered = self._entered_of(session, name)
        entered.append(mine)
        entered.sort(key=lambda each: each.since)
        return None

    def at(self, session: Session, provenance: Provenance) -> Campaign | None:
        """Return what a campaign was when a file of it was made; None where nothing says what it is."""
        name = provenance.subject.campaign
        entered = self._entered_of(session, name)
        if not entered:
            row = _row(session, name)
            return None if row is None else campaigns.definition(row)
        before = [each for each in entered if each.since <= provenance.created_at]
        return (before[-1] if before else entered[0]).campaign

    def _latest_of(self, name: str) -> Definition | None:
        """Return the latest definition of a campaign that can be read."""
        if name not in self._latest:
            self._latest[name] = next(filter(None, map(self._whole, reversed(self._paths[name]))), None)
        return self._latest[name]

    def _whole(self, path: str) -> Definition | None:
        try:
            found = self._archive.examine(path, self._checker)
            if not layout.fits(path, found.provenance):
                return None
            return self._read(path, found.provenance.created_at)
        except SmsError:
            # It is judged and reported in its turn.
            return None

    def _read(self, path: str, since: datetime) -> Definition:
        with self._archive.open_unrecorded(path) as dataset:
            return Definition(path, since, dataset.read(CAMPAIGN, CampaignDefinition).campaign)

    def _entered_of(self, session: Session, name: str) -> list[Definition]:
        """Return what the catalogue knew of a campaign before, and what was found since, by time."""
        if name not in self._entered:
            rows = session.scalars(
                select(FileRow)
                .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
                .where(CampaignRow.name == name, FileRow.source == CAMPAIGN)
                .order_by(FileRow.created_at)
            )
            self._entered[name] = [each for file in rows if (each := self._whole(file.path))]
        return self._entered[name]


def _row(session: Session, name: str) -> CampaignRow | None:
    return session.scalar(select(CampaignRow).where(CampaignRow.name == name))
