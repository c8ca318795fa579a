"""Which results would be others if they were computed now: the one definition of stale."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue.tables.calibrations import CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow, ResultRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.catalogue.valid_calibrations import ValidCalibrations
from sms_jobs.jobs.archiving.indexing import CAMPAIGN
from sms_jobs.jobs.results.turned import turned_files
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.subject import Subject

_NOT_BY_PLACE = (CALIBRATION, CAMPAIGN)
"""Inputs that are not chosen as the newest of their place: what holds is looked at by itself."""


class _Place(NamedTuple):
    campaign: str
    source: str
    state: str | None
    view: str | None
    media_type: str

    def __str__(self) -> str:
        return f"{self.source} {Subject(self.campaign, self.state, self.view)}"


class _File(NamedTuple):
    place: _Place
    content_hash: str
    version: int | None


@dataclass
class _Graph:
    """The files of some campaigns, the oldest first, and the pairs of output and input among them."""

    files: dict[int, _File] = field(default_factory=dict)
    edges: list[tuple[int, int]] = field(default_factory=list)
    turned: set[int] = field(default_factory=set)
    why: dict[int, str] = field(default_factory=dict)

    def newest(self) -> dict[_Place, int]:
        """Return what is taken as the newest of each place: one of the present frame, if there is any."""
        found: dict[_Place, int] = {}
        for number, file in self.files.items():
            if number not in self.turned or found.get(file.place, number) in self.turned:
                found[file.place] = number
        return found


def stale_files(session: Session, campaign: CampaignRow, now: datetime) -> dict[int, str]:
    """Return the stale results of a campaign and of those it takes inputs from, and why.

    A result is stale where another version of its kind would compute it now, another calibration holds for
    what it was computed from, it lies along the axes of another frame of the specimen, or the newest result
    about the subject of one of its inputs has other contents than that input or is stale itself. It takes a
    few queries a campaign, however large that is.

    Parameters
    ----------
    now
        Stands for the time of what is not measured yet.
    """
    graph = _Graph()
    reached, pending = {campaign.id}, [campaign]
    while pending:
        others = _add(session, graph, pending.pop(), now) - reached
        reached |= others
        pending += [session.get_one(CampaignRow, number) for number in others]
    newest = graph.newest()
    why = dict(graph.why)
    made_of: defaultdict[int, list[int]] = defaultdict(list)
    for output, given in graph.edges:
        then, place = graph.files[given], graph.files[given].place
        if graph.files[newest[place]].content_hash != then.content_hash:
            why.setdefault(output, f"its input {place} was made again, with other contents")
        made_of[newest[place]].append(output)
    front = deque(why)
    while front:
        number = front.popleft()
        for output in made_of[number]:
            if output not in why:
                why[output] = f"its input {graph.files[number].place} is stale"
                front.append(output)
    return why


def _add(session: Session, graph: _Graph, campaign: CampaignRow, now: datetime) -> set[int]:
    """Add the files of a campaign; return the campaigns that inputs of them are of."""
    rows = session.execute(
        select(
            FileRow.id,
            FileRow.source,
            LoadStateRow.label,
            FileRow.view,
            FileRow.media_type,
            FileRow.content_hash,
            ResultRow.kind_version,
        )
        .outerjoin(LoadStateRow, LoadStateRow.id == FileRow.state_id)
        .outerjoin(ResultRow, ResultRow.file_id == FileRow.id)
        .where(FileRow.campaign_id == campaign.id)
        .order_by(FileRow.id)
    )
    files = {
        number: _File(_Place(campaign.name, source, label, view, media_type), content_hash, version)
        for number, source, label, view, media_type, content_hash, version in rows
    }
    turned = turned_files(session, campaign)
    graph.files |= files
    graph.turned |= turned
    graph.why |= _by_themselves(session, campaign, now, files, turned)
    output, given = aliased(FileRow), aliased(FileRow)
    edges = session.execute(
        select(ProvenanceRow.output_id, ProvenanceRow.input_id, given.campaign_id)
        .join(output, output.id == ProvenanceRow.output_id)
        .join(given, given.id == ProvenanceRow.input_id)
        .where(
            output.campaign_id == campaign.id,
            given.campaign_id.is_not(None),
            given.source.not_in(_NOT_BY_PLACE),
        )
    ).all()
    graph.edges += [(output_id, input_id) for output_id, input_id, _ in edges]
    return {number for *_, number in edges if number is not None}


def _by_themselves(
    session: Session, campaign: CampaignRow, now: datetime, files: dict[int, _File], turned: set[int]
) -> dict[int, str]:
    """Return why results are stale whatever has become of their inputs."""
    used = _calibrations_used(session, campaign.id)
    valid = ValidCalibrations(session, campaign.id, now)
    why = {}
    for number, (place, _, version) in files.items():
        kind = all_kinds().get(place.source)
        if kind is None:
            continue
        if version not in (None, kind.version):
            why[number] = f"{place.source} is now version {kind.version}, it was made by {version}"
        elif number in turned:
            why[number] = "the specimen's frame of the campaign is another now"
        elif place.state is not None and (own := used.get(number)):
            holding = valid.of(Subject(campaign.name, place.state, place.view))
            if holding is None:
                why[number] = "its calibration is not in use any more, and there is no other"
            elif holding.number not in own:
                why[number] = "another calibration of the rig is valid for this state now"
    return why


def _calibrations_used(session: Session, campaign_id: int) -> dict[int, set[int]]:
    rows = session.execute(
        select(CalibrationUseRow.file_id, CalibrationUseRow.calibration_id)
        .join(FileRow, FileRow.id == CalibrationUseRow.file_id)
        .where(FileRow.campaign_id == campaign_id)
    )
    used: dict[int, set[int]] = {}
    for file, calibration in rows:
        used.setdefault(file, set()).add(calibration)
    return used
