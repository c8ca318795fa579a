"""Where a sealed file came from, and what is known of it from outside."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache
from math import isfinite
from typing import Any, Protocol

from pydantic import TypeAdapter, ValidationError

from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.records.subject import Subject


@dataclass(frozen=True)
class InputReference:
    """One input of a job.

    Attributes
    ----------
    role, source
        As its kind declared the need.
    path
        Of the sealed file, relative to the archive.
    content_hash
        That the file had when it was read.
    """

    role: str
    source: str
    path: str
    content_hash: str


@dataclass(frozen=True)
class Provenance:
    """How a file came about.

    Attributes
    ----------
    kind, kind_version
        What made it.
    subject
        What it is about.
    job_id, attempt
        Who made it; the job is empty for a calibration that a person brought in.
    created_at
        With time zone.
    parameters
        Of the kind, as JSON.
    inputs
        Everything that was read.
    program_version, host, operator
        Version of `sms_jobs`, name of the computer, name of the person.
    statistics
        The numbers that the file can be found by, by name; all finite.
    """

    kind: str
    kind_version: int
    subject: Subject
    job_id: str
    attempt: int
    created_at: datetime
    parameters: Mapping[str, Any]
    inputs: tuple[InputReference, ...]
    program_version: str
    host: str
    operator: str
    statistics: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Sealed:
    """A sealed file.

    Attributes
    ----------
    path
        Relative to the archive, with forward slashes.
    content_hash
        SHA-256 in hexadecimal: of the contents of a dataset file, of the bytes of a document.
    size_bytes
        Of the file.
    media_type
        E.g. application/x-hdf5.
    sha256
        Of the file's bytes; empty where it is not known.
    """

    path: str
    content_hash: str
    size_bytes: int
    media_type: str
    sha256: str = ""


class Recorded(Protocol):
    """What is on record of a sealed file, as in the catalogue: the same as in `Sealed`."""

    @property
    def path(self) -> str: ...  # noqa: D102

    @property
    def content_hash(self) -> str: ...  # noqa: D102

    @property
    def size_bytes(self) -> int: ...  # noqa: D102

    @property
    def sha256(self) -> str: ...  # noqa: D102


@dataclass(frozen=True)
class Found:
    """A sealed file that was read as a whole, and what it says of itself."""

    sealed: Sealed
    provenance: Provenance


@cache
def _json() -> TypeAdapter[Provenance]:
    return TypeAdapter(Provenance)


def provenance_to_json(provenance: Provenance) -> str:
    """Write a provenance as JSON."""
    return json.dumps(_json().dump_python(provenance, mode="json", warnings="error"), ensure_ascii=False)


def provenance_from_json(text: str | bytes, path: str) -> Provenance:
    """Read a provenance from JSON; raise `ArchiveCorrupt`, naming the file at `path`, if it is none."""
    try:
        provenance = _json().validate_json(text, strict=True)
    except ValidationError as error:
        raise ArchiveCorrupt(
            f"{path} has no readable provenance ({error.error_count()} errors); restore it from a backup"
        ) from error
    infinite = [name for name, value in provenance.statistics.items() if not isfinite(value)]
    if infinite:
        raise ArchiveCorrupt(
            f"the statistic {infinite[0]} of {path} is not finite, so that it cannot be searched by; restore "
            "the file from a backup"
        )
    return provenance


def digest(text: str | bytes) -> str:
    """Return the SHA-256 of a text in UTF-8, or of bytes, in hexadecimal."""
    return hashlib.sha256(text.encode() if isinstance(text, str) else text).hexdigest()


def digest_of(about: Mapping[str, Any]) -> str:
    """Return what covers all that is said beside a document."""
    return digest(json.dumps(about, sort_keys=True, separators=(",", ":"), ensure_ascii=False))
