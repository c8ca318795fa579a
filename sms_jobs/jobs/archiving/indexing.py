"""Enters sealed files into the catalogue, whoever sealed them, and finds the files of a job's inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any, cast

from sqlalchemy import Row, Table, and_, bindparam, select, update
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE, InputReference, Provenance, Sealed
from sms_jobs.catalogue import campaigns, lineage, subject_files, valid_calibrations
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow, ProvenanceRow, ResultRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.jobs.archiving import calibration_choice, decisions
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, REFERENCE_SURFACES
from sms_jobs.kinds.products import MEASURED, RECORDED
from sms_jobs.records.calibration import Acceptance
from sms_jobs.records.campaign import CampaignDefinition
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject

CAMPAIGN = "campaign"
"""The source of files that define campaigns."""
ACCEPTANCE = "acceptance"
"""The source of files that say whether a calibration is used."""
_KEPT: dict[str, type[Any]] = {CAMPAIGN: CampaignDefinition, CALIBRATION: Calibration, ACCEPTANCE: Acceptance}
"""Records that the catalogue keeps itself; each has in its file the name of its source."""
# Every job asks this: making the statement takes longer than running it, and so does loading rows as objects.
_EDGE = cast(Table, DependencyRow.__table__)
_INPUTS = select(_EDGE).where(_EDGE.c.job_id == bindparam("job")).order_by(_EDGE.c.role)


@dataclass(frozen=True)
class ResolvedInput:
    """The file that meets a need of a job."""

    role: str
    source: str
    path: str
    content_hash: str
    size_bytes: int
    sha256: str


def resolve_inputs(session: Session, job_id: str, now: datetime) -> tuple[ResolvedInput, ...]:
    """Find the files of a job's inputs, now that their producers are done, and note them in its row.

    The recordings decide which calibration applies, whichever applied when the job was planned.

    Raises
    ------
    ArchiveCorrupt
        A producer has succeeded, but the catalogue knows no such file of it.
    """
    found = []
    session.flush()
    edges = session.execute(_INPUTS, {"job": job_id}).all()
    for edge in edges:
        file_id = _calibration(session, edge, now) or edge.file_id or _produced(session, edge)
        file = session.get(FileRow, file_id) if file_id else None
        if file is None:
            raise ArchiveCorrupt(
                f"the {edge.source} of {edge.subject} is missing from the catalogue although the job that "
                "makes it has succeeded; retry that job"
            )
        if edge.file_id != file.id:
            session.execute(
                update(DependencyRow)
                .where(DependencyRow.job_id == job_id, DependencyRow.role == edge.role)
                .values(file_id=file.id)
            )
        recorded = file.path, file.content_hash, file.size_bytes, file.sha256
        found.append(ResolvedInput(edge.role, edge.source, *recorded))
    return tuple(found)


def _calibration(session: Session, edge: Row[Any], now: datetime) -> int | None:
    if edge.source != CALIBRATION:
        return None
    used = calibration_choice.chosen(session, Subject.parse(edge.subject), now)
    return None if used is None else used.file_id


def _produced(session: Session, edge: Row[Any]) -> int | None:
    producer = session.get_one(JobRow, edge.producer_id)
    subject = Subject.parse(edge.subject)
    query = select(FileRow.id).where(
        FileRow.job_id == (producer.reused_from or producer.id),
        FileRow.source == edge.source,
        # A job may make documents for people besides: jobs need datasets.
        FileRow.media_type == DATASET_MEDIA_TYPE,
    )
    if subject.view is not None:
        query = query.where(FileRow.view == subject.view)
    if subject.state is not None:
        query = query.join(LoadStateRow, LoadStateRow.id == FileRow.state_id).where(
            LoadStateRow.label == subject.state
        )
    return session.scalar(query.order_by(FileRow.id.desc()).limit(1))


@dataclass(frozen=True)
class Entry:
    """What the catalogue has to know of a sealed file.

    Attributes
    ----------
    sealed, provenance
        The file, and where it is from.
    record
        What the catalogue keeps itself: a definition, a calibration or a decision about one; else None.
    recorded_at, readings
        Of a measurement: when it was recorded, and what scalar channels read meanwhile.
    """

    sealed: Sealed
    provenance: Provenance
    record: CampaignDefinition | Calibration | Acceptance | None = None
    recorded_at: datetime | None = None
    readings: Mapping[str, float] = field(default_factory=dict)

    @property
    def source(self) -> str:
        """What the file is found as."""
        return source_of(self.provenance)


def source_of(provenance: Provenance) -> str:
    """Return what a file is found as: a measurement, or what its kind makes."""
    kind = all_kinds().get(provenance.kind)
    return (kind.makes if kind is not None else "") or provenance.kind


def entry_of(sealed: Sealed, provenance: Provenance, read: Callable[[str, type[Any]], Any]) -> Entry:
    """Return what is indexed of a file; `read` gives one of its records, or None where it has none."""
    entry = Entry(sealed, provenance)
    if sealed.media_type != DATASET_MEDIA_TYPE:
        return entry
    if entry.source in _KEPT:
        return replace(entry, record=read(entry.source, _KEPT[entry.source]))
    if entry.source != MEASUREMENT:
        return entry
    measurement, recording = (read(one.name, one.record) for one in (MEASURED, RECORDED))
    return replace(
        entry,
        recorded_at=None if measurement is None else measurement.recorded_at,
        readings={} if recording is None else recording.readings(),
    )


def index(session: Session, entry: Entry, at: datetime) -> int:
    """Enter a sealed file into the catalogue, with all that follows from it; return its number.

    Live and from files alone it is the same. What it was computed from is entered before, and so is its job.

    Parameters
    ----------
    at
        When it is entered.

    Raises
    ------
    Conflict, InvalidInput, NotFound
        A decision does not fit what the catalogue has, or the campaign is not known.
    """
    provenance, record = entry.provenance, entry.record
    if isinstance(record, CampaignDefinition):
        _define(session, record, provenance.created_at)
    file = _file_row(session, entry, at)
    if isinstance(record, Acceptance):
        decisions.decide(session, record, provenance.created_at, file.id)
    if entry.source in (CAMPAIGN, ACCEPTANCE):
        return file.id
    if isinstance(record, Calibration):
        valid_calibrations.add_calibration(session, record, file.id)
    elif entry.recorded_at is not None:
        _describe_recording(session, entry, file)
    elif entry.source != REFERENCE_SURFACES:
        session.add(ResultRow(file_id=file.id, kind=provenance.kind, kind_version=provenance.kind_version))
    session.add_all(
        StatisticRow(file_id=file.id, name=name, value=value) for name, value in provenance.statistics.items()
    )
    session.add_all(
        ProvenanceRow(output_id=file.id, role=role, input_id=number)
        for role, number in _inputs(session, provenance.inputs)
    )
    lineage.note_calibrations(session, file.id)
    if entry.recorded_at is None:
        lineage.note_recordings(session, file)
    return file.id


def existing_file(session: Session, entry: Entry) -> int | None:
    """Return the file from which the catalogue has the same already; None where it does not.

    The same are calibrations of equal contents, a decision that is made, and the surface that the campaign
    is compared with at present. Everything else is entered as often as it is sealed.
    """
    record, source = entry.record, entry.source
    if isinstance(record, Calibration):
        return calibration_file(session, entry.sealed.content_hash)
    if isinstance(record, Acceptance) and decisions.is_made(session, record):
        return calibration_file(session, record.calibration)
    if source == REFERENCE_SURFACES:
        number = subject_files.newest_file(
            session, REFERENCE_SURFACES, entry.provenance.subject, DATASET_MEDIA_TYPE
        )
        if number and session.get_one(FileRow, number).content_hash == entry.sealed.content_hash:
            return number
    return None


def calibration_file(session: Session, content_hash: str) -> int | None:
    """Return the file of a calibration with these contents; None where the catalogue has none."""
    return session.scalar(
        select(FileRow.id).where(FileRow.source == CALIBRATION, FileRow.content_hash == content_hash)
    )


def input_of(session: Session, given: InputReference) -> int | None:
    """Return the number of an input; a calibration may have been entered from another file of the same."""
    return next((number for _, number in _inputs(session, (given,))), None)


def _inputs(session: Session, given: Sequence[InputReference]) -> Iterator[tuple[str, int]]:
    """Yield the role and the number of every input that the catalogue has."""
    lying: dict[tuple[str, str], int] = {}
    for some in parts([one.path for one in given]):
        rows = session.execute(
            select(FileRow.path, FileRow.content_hash, FileRow.id).where(FileRow.path.in_(some))
        )
        lying |= {(path, content_hash): number for path, content_hash, number in rows}
    for one in given:
        number = lying.get((one.path, one.content_hash))
        if number is None and one.source == CALIBRATION:
            number = calibration_file(session, one.content_hash)
        if number is not None:
            yield one.role, number


def _define(session: Session, definition: CampaignDefinition, since: datetime) -> None:
    """Make a campaign what a definition says, unless a later one is known."""
    row = session.scalar(select(CampaignRow).where(CampaignRow.name == definition.campaign.name))
    if row is None:
        campaigns.add_campaign(session, definition.campaign, since, definition.plan)
        return
    later = select(FileRow.id).where(
        FileRow.campaign_id == row.id, FileRow.source == CAMPAIGN, FileRow.created_at > since
    )
    if session.scalar(later) is None:
        campaigns.bring_up_to_date(session, row, definition.campaign)


def _file_row(session: Session, entry: Entry, at: datetime) -> FileRow:
    """Enter what is on record of a sealed file, by which its readers know it again."""
    sealed, subject = entry.sealed, entry.provenance.subject
    campaign_id, state_id = None, None
    of_a_rig = entry.source in (CALIBRATION, ACCEPTANCE)
    if not of_a_rig:
        campaign_id, state_id = _place(session, subject)
    row = FileRow(
        source=entry.source,
        path=sealed.path,
        content_hash=sealed.content_hash,
        size_bytes=sealed.size_bytes,
        sha256=sealed.sha256,
        media_type=sealed.media_type,
        created_at=at,
        campaign_id=campaign_id,
        state_id=state_id,
        view=None if of_a_rig else subject.view,
        job_id=entry.provenance.job_id or None,
    )
    session.add(row)
    session.flush()
    return row


def _place(session: Session, subject: Subject) -> tuple[int, int | None]:
    """Return the numbers of the campaign and the state of a subject."""
    query = (
        select(CampaignRow.id, LoadStateRow.id)
        .outerjoin(
            LoadStateRow,
            and_(LoadStateRow.campaign_id == CampaignRow.id, LoadStateRow.label == subject.state),
        )
        .where(CampaignRow.name == subject.campaign)
    )
    found = session.execute(query).one_or_none()
    return (campaigns.campaign_id(session, subject.campaign), None) if found is None else (found[0], found[1])


def _describe_recording(session: Session, entry: Entry, file: FileRow) -> None:
    assert entry.recorded_at is not None
    session.add(
        MeasurementRow(
            file_id=file.id, state_id=file.state_id, view=file.view or "", recorded_at=entry.recorded_at
        )
    )
    lineage.note_recording(session, file, entry.recorded_at, entry.readings)
    if file.state_id is not None:
        valid_calibrations.note_time(session, file.state_id, entry.recorded_at)


def paths_of(session: Session, job_id: str) -> set[str]:
    """Return the paths of the files that a job has made and that are indexed."""
    return set(session.scalars(select(FileRow.path).where(FileRow.job_id == job_id)))
