"""Which calibrations of a portable folder are used where it comes to: for the campaigns that they come with.

For their rig, and for campaigns that are there already, they wait until somebody accepts them: a folder of
others changes nothing that is measured here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING

from sqlalchemy import select

from sms_jobs.archive import Archive, Checker, Found, layout
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.errors import SmsError
from sms_jobs.jobs.archiving import acceptances
from sms_jobs.jobs.archiving.indexing import ACCEPTANCE, CAMPAIGN
from sms_jobs.jobs.archiving.repository import Repository
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.records.campaign import Campaign, CampaignDefinition

if TYPE_CHECKING:
    from sms_jobs.records.calibration import Acceptance


@dataclass(frozen=True)
class Decision:
    """A decision of a portable folder as it counts here.

    Attributes
    ----------
    acceptance
        For a campaign that comes with it.
    calibration
        Path of the calibration.
    path
        Of the file that says so; None where the folder says it of the whole rig.
    """

    acceptance: Acceptance
    calibration: str
    path: str | None


def decisions(
    catalogue: Catalogue, brought: Archive, listed: Collection[str], checker: Checker
) -> list[Decision]:
    """Return what the decisions of a portable folder come to in a catalogue.

    Parameters
    ----------
    brought
        The folder's archive.
    listed
        What of it its manifest lists.
    """
    campaigns = {c.name: c for c in _new_campaigns(catalogue, brought, listed, checker)}
    in_use = list(_decisions_in_use(brought, listed, checker))
    own = [one for one in in_use if one.acceptance.campaign in campaigns]
    have_own = {one.acceptance.campaign for one in own}
    of_rigs = (
        Decision(replace(one.acceptance, campaign=campaign.name), one.calibration, None)
        for campaign in campaigns.values()
        for one in in_use
        if one.acceptance.campaign is None
        and one.acceptance.rig == campaign.rig
        and campaign.name not in have_own
    )
    return [*own, *of_rigs]


def _new_campaigns(
    catalogue: Catalogue, brought: Archive, listed: Collection[str], checker: Checker
) -> Iterator[Campaign]:
    """Return the campaigns of a folder that the catalogue does not know."""
    with catalogue.reading() as session:
        registered = set(session.scalars(select(CampaignRow.name)))
    for path in _of_kind(brought, listed, CAMPAIGN):
        if layout.campaign_of(path) not in registered and _is_whole(brought, path, checker):
            try:
                with brought.open_unrecorded(path) as dataset:
                    yield dataset.read(CAMPAIGN, CampaignDefinition).campaign
            except SmsError:
                continue  # it is judged and reported in its turn


def _decisions_in_use(brought: Archive, listed: Collection[str], checker: Checker) -> Iterator[Decision]:
    for path in _of_kind(brought, listed, ACCEPTANCE):
        found = reindexing.examined(brought, checker, path)
        if isinstance(found, Found) and layout.fits(path, found.provenance) and found.provenance.inputs:
            try:
                acceptance = acceptances.read(brought, path)
            except SmsError:
                continue
            if acceptance.in_use:
                yield Decision(acceptance, found.provenance.inputs[0].path, path)


def _is_whole(brought: Archive, path: str, checker: Checker) -> bool:
    found = reindexing.examined(brought, checker, path)
    return isinstance(found, Found) and layout.fits(path, found.provenance)


def _of_kind(brought: Archive, listed: Collection[str], kind: str) -> list[str]:
    return sorted(p for p in brought.files() if p in listed and layout.part(p, "kind") == kind)


def seal_missing(
    catalogue: Catalogue,
    archive: Archive,
    required: Collection[Decision],
    names: Collection[str],
    now: datetime,
) -> set[str]:
    """Seal what a folder says of whole rigs as decisions about its campaigns.

    Parameters
    ----------
    names
        Of all campaigns of the folder.

    Returns
    -------
    The paths of all decisions about these campaigns that the catalogue is still to learn of: an import that
    was interrupted may have left some.
    """
    left = {}
    for path in reindexing.unknown_files(catalogue, archive):
        if layout.is_decision(path):
            with suppress(SmsError):
                left[path] = acceptances.read(archive, path)
    paths = {path for path, acceptance in left.items() if acceptance.campaign in names}
    repository = Repository(catalogue, archive)
    for one in required:
        if one.path is None and one.acceptance not in left.values():
            provenance = acceptances.decided(one.acceptance, one.calibration, now)
            paths.add(repository.seal({ACCEPTANCE: one.acceptance}, provenance).sealed.path)
    return paths
