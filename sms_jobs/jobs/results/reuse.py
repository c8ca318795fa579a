"""When a job need not run: the same kind, version, parameters and inputs have given a result before."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

from pydantic import TypeAdapter
from sqlalchemy import Table, bindparam, func, select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import ArchiveCorrupt, OtherFormat
from sms_jobs.kinds.kind import Kind
from sms_jobs.records.job import JobState
from sms_jobs.records.remarks import remarks_in
from sms_jobs.records.subject import Subject

_ANYTHING = TypeAdapter(Any)
# Every job asks these: making the statements takes longer than running them, and so does what loads rows as
# objects.
_JOB = cast(Table, JobRow.__table__)
_FILE = cast(Table, FileRow.__table__)
_NEWEST = (
    select(_JOB.c.id)
    .where(
        _JOB.c.reuse_key == bindparam("key"),
        _JOB.c.state == JobState.SUCCEEDED,
        _JOB.c.reused_from.is_(None),
        _JOB.c.repeatable,
    )
    .order_by(_JOB.c.finished_at.desc())
    .limit(1)
)
_SEEN = _FILE.alias()
_FILES = (
    select(
        _FILE.c.job_id,
        _FILE.c.path,
        _FILE.c.content_hash,
        _FILE.c.size_bytes,
        _FILE.c.sha256,
        _JOB.c.message,
        select(func.count()).where(_SEEN.c.job_id == _FILE.c.job_id).scalar_subquery().label("seen"),
    )
    .join(_JOB, _JOB.c.id == _FILE.c.job_id)
    .where(_FILE.c.job_id == _NEWEST.scalar_subquery())
    .order_by(_FILE.c.id)
    .with_for_update(read=True, key_share=True, of=_FILE)
)


def reuse_key(
    kind: Kind[Any],
    subject: Subject,
    parameters: Mapping[str, Any],
    context: object,
    inputs: Mapping[str, str],
) -> str:
    """Return the SHA-256 of everything that a job's outputs depend on.

    Parameters
    ----------
    kind
        Its name and version count.
    subject
        Named in the outputs.
    parameters
        Complete, defaults included.
    context
        What the kind took from the campaign's definition.
    inputs
        Content hash of each input by role.
    """
    parts = {
        "kind": kind.name,
        "version": kind.version,
        "subject": str(subject),
        "parameters": parameters,
        "context": _ANYTHING.dump_python(context, mode="json"),
        "inputs": inputs,
    }
    canonical = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


@dataclass(frozen=True)
class EarlierFile:
    """A file of an earlier result, as it is on record."""

    path: str
    content_hash: str
    size_bytes: int
    sha256: str


@dataclass(frozen=True)
class Earlier:
    """The job that computed the same before, its files, and what it remarked."""

    job_id: str
    files: tuple[EarlierFile, ...]
    remarks: str = ""

    @property
    def size_bytes(self) -> int:
        """Of all files."""
        return sum(file.size_bytes for file in self.files)


def earlier_success(session: Session, key: str) -> Earlier | None:
    """Return the newest job that computed the same, and its files, if there is one."""
    # Locked, so that no policy removes them before this is committed. Those that one removes just now are
    # waited for, and counted, but do not come any more.
    files = session.execute(_FILES, {"key": key}).all()
    if not files or len(files) < files[0].seen:
        return None
    earlier = (EarlierFile(file.path, file.content_hash, file.size_bytes, file.sha256) for file in files)
    return Earlier(files[0].job_id, tuple(earlier), remarks_in(files[0].message))


def damage(archive: Archive, earlier: Earlier) -> str:
    """Say what of an earlier result is not as it was sealed; empty when all is. Every byte of it is read."""
    for file in earlier.files:
        try:
            archive.verify_bytes(file)
        except (ArchiveCorrupt, OtherFormat) as error:
            return str(error)
    return ""
