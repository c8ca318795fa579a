"""Gathers where files come from, from the files themselves and the catalogue, for a PROV document."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive, Provenance, layout
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.search import file_view
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import NotFound
from sms_jobs.formats.provenance_document import (
    DocumentedActivity,
    DocumentedFile,
    DocumentedInput,
    provenance_document,
)

_AT_ONCE = 500


@dataclass
class _Gathered:
    files: dict[str, DocumentedFile] = field(default_factory=dict)
    provenances: dict[str, Provenance] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)


def paths_of(session: Session, key: str) -> list[str]:
    """Return the file of a number or archive path, or all files of the campaign of that name.

    Raises
    ------
    NotFound
        There is neither.
    """
    row = session.scalar(select(CampaignRow).where(CampaignRow.name == key))
    if row is not None:
        query = select(FileRow.path).where(FileRow.campaign_id == row.id).order_by(FileRow.id)
        return list(session.scalars(query))
    try:
        return [file_view(session, key).path]
    except NotFound as error:
        raise NotFound(
            f"'{key}' is neither a file nor a campaign; 'sms data find' and 'sms campaign list' show them"
        ) from error


def document_of(catalogue: Catalogue, archive: Archive, paths: Iterable[str]) -> dict[str, Any]:
    """Return a PROV-JSON document of files and of all that they were computed from.

    What files say of themselves comes first; the catalogue adds sizes, and times of jobs. A file that is not
    there any more, or cannot be read, is an entity all the same, without what made it.
    """
    gathered = _Gathered()
    pending = list(paths)
    while pending:
        level, pending = pending, []
        with catalogue.reading() as session:
            rows = _rows(session, level)
        for path in level:
            if path in gathered.files:
                continue
            if (row := rows.get(path)) is not None:
                gathered.hashes[path] = row.content_hash
            provenance = archive.provenance(path)
            gathered.files[path] = _documented(path, gathered.hashes.get(path), row, provenance)
            if provenance is None:
                continue
            gathered.provenances[path] = provenance
            for given in provenance.inputs:
                gathered.hashes.setdefault(given.path, given.content_hash)
                pending.append(given.path)
        pending = [path for path in dict.fromkeys(pending) if path not in gathered.files]
    return provenance_document(gathered.files.values(), _activities(catalogue, gathered))


def _rows(session: Session, paths: list[str]) -> dict[str, FileRow]:
    found: dict[str, FileRow] = {}
    for start in range(0, len(paths), _AT_ONCE):
        query = select(FileRow).where(FileRow.path.in_(paths[start : start + _AT_ONCE]))
        found |= {row.path: row for row in session.scalars(query)}
    return found


def _documented(
    path: str, content_hash: str | None, row: FileRow | None, provenance: Provenance | None
) -> DocumentedFile:
    attributes: dict[str, Any] = {"readable": provenance is not None}
    if provenance is not None:
        attributes |= {"kind": provenance.kind, "subject": str(provenance.subject)}
        attributes |= {f"statistic.{name}": value for name, value in sorted(provenance.statistics.items())}
    if row is not None:
        attributes |= {"kind": row.source, "size_bytes": row.size_bytes, "media_type": row.media_type}
    return DocumentedFile(path, content_hash or "", attributes)


def _activities(catalogue: Catalogue, gathered: _Gathered) -> list[DocumentedActivity]:
    """Group files by what made them: a job, or the hand that brought one in."""
    groups: dict[str, list[str]] = {}
    for path, provenance in gathered.provenances.items():
        name = provenance.job_id or f"{layout.stem(provenance)}-of-{provenance.subject}".replace("/", "-")
        groups.setdefault(name, []).append(path)
    with catalogue.reading() as session:
        times = _times(session, list(groups))
    made = []
    for name, paths in groups.items():
        latest = max((gathered.provenances[path] for path in paths), key=lambda one: one.created_at)
        begun, ended = times.get(name, (None, latest.created_at))
        used = {given.role: given.path for path in paths for given in gathered.provenances[path].inputs}
        made.append(
            DocumentedActivity(
                name=name,
                started=begun,
                ended=ended,
                program_version=latest.program_version,
                host=latest.host,
                operator=latest.operator,
                attributes={
                    "kind": latest.kind,
                    "kind_version": latest.kind_version,
                    "attempt": latest.attempt,
                    "parameters": json.dumps(dict(latest.parameters), sort_keys=True, ensure_ascii=False),
                },
                used=tuple(DocumentedInput(role, path) for role, path in sorted(used.items())),
                outputs=tuple(
                    (path, gathered.provenances[path].created_at.astimezone(UTC)) for path in paths
                ),
            )
        )
    return made


def _times(session: Session, job_ids: list[str]) -> dict[str, tuple[datetime | None, datetime | None]]:
    found: dict[str, tuple[datetime | None, datetime | None]] = {}
    for start in range(0, len(job_ids), _AT_ONCE):
        query = select(JobRow.id, JobRow.started_at, JobRow.finished_at)
        rows = session.execute(query.where(JobRow.id.in_(job_ids[start : start + _AT_ONCE])))
        found |= {row.id: (row.started_at, row.finished_at) for row in rows}
    return found
