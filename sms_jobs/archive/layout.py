"""Where files lie in the archive, and what their names say.

`<campaign>/<state>/<view>/<kind>-<time>-<job>-<attempt>.h5`, without the parts that the subject does not
have; `<job>` is the beginning of the job's id. A document adds its own name: `...-<attempt>-<filename>`,
and has its provenance beside it in `...-<attempt>-<filename>.provenance.json`. A file that is being written
is called `.<name>.<whole job id>.tmp`. Folders that begin with a dot hold no part of the archive.
"""

from __future__ import annotations

import re
from datetime import UTC
from typing import TYPE_CHECKING

from sms_jobs.errors import InvalidInput
from sms_jobs.records.subject import RESERVED_NAME, Subject, checked_name

if TYPE_CHECKING:
    from sms_jobs.archive.provenance import Provenance

CALIBRATIONS = RESERVED_NAME
SET_ASIDE = ".set-aside"
OF_A_CRATE = frozenset({"ro-crate-metadata.json", "provenance.prov.json"})
"""Beside the files of an exported campaign, which is an archive too."""
JOB_LETTERS = 8
NO_JOB = "nojob"
_JOB_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_FILENAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_SIDECAR = ".provenance.json"
_SEALED = re.compile(
    r"(?P<kind>.+?)-(?P<time>\d{8}T\d{6}Z)-(?P<job>\w{1,8})-(?P<attempt>\d+)((?P<dataset>\.h5)|-.+)"
)


def checked_job_id(job_id: str) -> str:
    """Return a job's id when it can stand in a file name; raise `InvalidInput` if not."""
    if not _JOB_ID.fullmatch(job_id):
        raise InvalidInput(f"'{job_id}' cannot be the id of a job in a file name")
    return job_id


def short_job_id(job_id: str) -> str:
    """Return what file names show of a job's id: its first letters and digits."""
    return re.sub(r"[^A-Za-z0-9]", "", checked_job_id(job_id))[:JOB_LETTERS]


def folder(subject: Subject) -> str:
    """Return the folder of a subject, relative to the archive."""
    parts = [checked_name(subject.campaign, "campaign")]
    if subject.state is not None:
        parts.append(checked_name(subject.state, "state"))
    if subject.view is not None:
        parts.append(checked_name(subject.view, "view"))
    return "/".join(parts)


def folder_of(relative: str) -> str:
    """Return the folder of a file, as `folder` makes it of a subject."""
    return relative.rpartition("/")[0]


def campaign_of(relative: str) -> str:
    """Return the campaign in whose folder a file or a folder lies; `CALIBRATIONS` of one of a rig."""
    return relative.partition("/")[0]


def identity(provenance: Provenance) -> str:
    """Return what tells a file from others of its kind and second: the job, or the absence of one."""
    return provenance.job_id or NO_JOB


def stem(provenance: Provenance) -> str:
    """Return `<kind>-<time>-<job>-<attempt>`; raise `InvalidInput` for a time without a zone."""
    if provenance.created_at.tzinfo is None:
        raise InvalidInput(f"the time {provenance.created_at} of {provenance.subject} has no time zone")
    kind = checked_name(provenance.kind, "job kind")
    stamp = provenance.created_at.astimezone(UTC).strftime("%Y%m%dT%H%M%SZ")
    return f"{kind}-{stamp}-{short_job_id(identity(provenance))}-{int(provenance.attempt)}"


def dataset_path(provenance: Provenance) -> str:
    """Return where a dataset file goes, relative to the archive."""
    return f"{folder(provenance.subject)}/{stem(provenance)}.h5"


def document_path(provenance: Provenance, filename: str) -> str:
    """Return where a document goes, relative to the archive."""
    if not _FILENAME.fullmatch(filename) or ".." in filename or filename.endswith(_SIDECAR):
        raise InvalidInput(
            f"'{filename}' cannot be the name of a document: use at most 100 letters, digits, '.', '_' or "
            "'-', beginning with a letter or digit"
        )
    return f"{folder(provenance.subject)}/{stem(provenance)}-{filename}"


def sidecar(document: str) -> str:
    """Return the name of the file that holds a document's provenance."""
    return f"{document}{_SIDECAR}"


def without_sidecar(relative: str) -> str:
    """Return the document that a file belongs to: itself, or the one whose provenance it holds."""
    return relative.removesuffix(_SIDECAR)


def is_dataset(relative: str) -> bool:
    """Say whether a path is that of a dataset file, not of a document."""
    found = _SEALED.fullmatch(_last(relative))
    return found is not None and found["dataset"] is not None


def is_result(relative: str) -> bool:
    """Say whether a path is that of a sealed dataset or document; the provenance of one is not."""
    name = _last(relative)
    return _SEALED.fullmatch(name) is not None and not name.endswith(_SIDECAR) and not name.startswith(".")


def is_decision(relative: str) -> bool:
    """Say whether a path is that of a decision whether a calibration is used."""
    return relative.startswith(f"{CALIBRATIONS}/") and part(relative, "kind") == "acceptance"


def temporary_name(name: str, job_id: str) -> str:
    """Return the name of a file while the job writes it."""
    return f".{name}.{checked_job_id(job_id)}.tmp"


def is_temporary_of(name: str, job_id: str) -> bool:
    """Say whether a file name is that of a file that the job was writing."""
    return name.startswith(".") and name.endswith(f".{job_id}.tmp")


def writer_of(name: str) -> str | None:
    """Return the id of the job that was writing a file of that name; None when it is no such file."""
    parts = name.split(".")
    return parts[-2] if name.startswith(".") and parts[-1] == "tmp" and len(parts) > 3 else None


def may_be_of(name: str, job_id: str) -> bool:
    """Say whether a file name may be that of a file that the job sealed; other jobs may begin alike."""
    found = _SEALED.fullmatch(name)
    return found is not None and found["job"] == short_job_id(job_id)


def part(relative: str, key: str) -> str:
    """Return the `kind`, `time`, `job` or `attempt` that the name of a sealed file shows."""
    found = _SEALED.fullmatch(_last(relative))
    if found is None:
        raise InvalidInput(f"'{relative}' is not the name of a sealed file")
    return found[key]


def attempt_of(relative: str, job_id: str) -> int:
    """Return which attempt of a job sealed a file, or was writing it."""
    name = _last(relative)
    if is_temporary_of(name, job_id):
        name = name[1:].removesuffix(f".{job_id}.tmp")
    return int(part(name, "attempt"))


def fits(relative: str, provenance: Provenance) -> bool:
    """Say whether a sealed file has the folder and the name that follow from its provenance."""
    expected = f"{folder(provenance.subject)}/{stem(provenance)}"
    return relative == f"{expected}.h5" if is_dataset(relative) else relative.startswith(f"{expected}-")


def _last(relative: str) -> str:
    """Return the last part of a path."""
    return relative.rpartition("/")[2]
