"""When a job need not run: the same kind, version, parameters and inputs have given a result before."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pydantic import TypeAdapter
from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import FileRow, JobRow
from sms_jobs.kinds.kind import Kind
from sms_jobs.records.campaign import Subject
from sms_jobs.records.job import JobState

_ANYTHING = TypeAdapter(Any)
# Every job asks these: making the statements takes longer than running them.
_NEWEST = (
    select(JobRow.id)
    .where(
        JobRow.reuse_key == bindparam("key"),
        JobRow.state == JobState.SUCCEEDED,
        JobRow.reused_from.is_(None),
        JobRow.repeatable,
    )
    .order_by(JobRow.finished_at.desc())
    .limit(1)
)
_PATHS = (
    select(FileRow.path)
    .where(FileRow.job_id == bindparam("job"))
    .order_by(FileRow.id)
    .with_for_update(read=True, key_share=True)
)
_KEY = select(JobRow.reuse_key).where(JobRow.id == bindparam("job"))


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


def earlier_success(session: Session, key: str) -> tuple[str, tuple[str, ...]] | None:
    """Return (job id, paths of its files) of the newest job that computed the same, if there is one."""
    job_id = session.scalar(_NEWEST, {"key": key})
    if job_id is None:
        return None
    # Locked, so that no policy lets them go before this is committed. One that did so meanwhile is seen by
    # the key, which is gone with the first of them.
    paths = tuple(session.scalars(_PATHS, {"job": job_id}))
    return (job_id, paths) if session.scalar(_KEY, {"job": job_id}) == key else None
