"""Enters a job's outputs into the catalogue, and finds the files of its inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from math import isfinite
from typing import Any, cast

from sqlalchemy import Row, Table, bindparam, select, update
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE, Sealed
from sms_jobs.catalogue import campaigns, lineage, valid_calibrations
from sms_jobs.catalogue.models import (
    DependencyRow,
    FileRow,
    JobRow,
    LoadStateRow,
    MeasurementRow,
    ProvenanceRow,
    ResultRow,
    StatisticRow,
)
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.jobs import calibration_choice
from sms_jobs.jobs.entering import enter_file
from sms_jobs.jobs.lifecycle import Claim
from sms_jobs.kinds.kind import CALIBRATION, DatasetOutput, Kind, Output
from sms_jobs.kinds.products import MEASURED, RECORDED
from sms_jobs.records.campaign import Subject

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


@dataclass(frozen=True)
class SealedOutput:
    """What the catalogue has to know of an output once it lies in the archive."""

    subject: Subject
    file: Sealed
    statistics: Mapping[str, float]
    recorded_at: datetime | None
    readings: Mapping[str, float]


def sealed_output(output: Output, file: Sealed) -> SealedOutput:
    """Keep of an output what is indexed, and let its arrays go."""
    if not isinstance(output, DatasetOutput):
        return SealedOutput(output.subject, file, {}, None, {})
    measurement, recording = output.products.get(MEASURED), output.products.get(RECORDED)
    recorded_at = None if measurement is None else measurement.recorded_at
    readings = {} if recording is None else recording.readings()
    return SealedOutput(output.subject, file, output.statistics, recorded_at, readings)


def resolve_inputs(session: Session, job_id: str, now: datetime) -> tuple[ResolvedInput, ...]:
    """Find the files of a job's inputs, now that their producers are done, and note them in its row.

    What is measured by now says which calibration holds for it, whatever held when the job was planned.

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


def add_outputs(
    session: Session, held: Claim, kind: Kind[Any], outputs: Sequence[SealedOutput], now: datetime
) -> None:
    """Index the sealed outputs of a job, with their statistics and where they come from."""
    labels = {o.subject.state for o in outputs if o.subject.state is not None}
    states = campaigns.state_ids(session, held.campaign_id, labels)
    for output in outputs:
        state_id = None if output.subject.state is None else states[output.subject.state]
        file = enter_file(
            session,
            output.file,
            kind.makes or kind.name,
            now,
            campaign_id=held.campaign_id,
            state_id=state_id,
            view=output.subject.view,
            job_id=held.job_id,
        )
        if output.recorded_at is None:
            session.add(ResultRow(file_id=file.id, kind=kind.name, kind_version=kind.version))
        else:
            session.add(
                MeasurementRow(
                    file_id=file.id,
                    state_id=state_id,
                    view=output.subject.view,
                    recorded_at=output.recorded_at,
                )
            )
            lineage.note_recording(session, file, output.recorded_at, output.readings)
            if state_id is not None:
                valid_calibrations.note_time(session, state_id, output.recorded_at)
        session.add_all(
            StatisticRow(file_id=file.id, name=name, value=float(value))
            for name, value in output.statistics.items()
            if isfinite(value)
        )
        _add_provenance(session, held.job_id, file.id)
        lineage.note_calibrations(session, file.id)
        if output.recorded_at is None:
            lineage.note_recordings(session, file)


def _add_provenance(session: Session, job_id: str, file_id: int) -> None:
    edges = session.execute(
        select(DependencyRow.role, DependencyRow.file_id).where(DependencyRow.job_id == job_id)
    ).all()
    session.add_all(ProvenanceRow(output_id=file_id, role=role, input_id=source) for role, source in edges)


def paths_of(session: Session, job_id: str) -> set[str]:
    """Return the paths of the files that a job has made and that are indexed."""
    return set(session.scalars(select(FileRow.path).where(FileRow.job_id == job_id)))
