"""A portable folder for files of an archive: an RO-Crate in a BagIt bag.

RO-Crate Metadata Specification 1.1 describes what the files are, for people and repositories; the BagIt File
Packaging Format 1.0 (RFC 8493) has their checksums, which `sha256sum -c manifest-sha256.txt` checks too.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import quote

from sms_jobs.errors import InvalidInput

PAYLOAD = "data"
"""The folder of a bag whose files the manifest lists, and the root of the crate."""
MANIFEST = "manifest-sha256.txt"
TAG_MANIFEST = "tagmanifest-sha256.txt"
DECLARATION = "bagit.txt"
INFORMATION = "bag-info.txt"
METADATA = "ro-crate-metadata.json"
PROVENANCE = "provenance.prov.json"
DECLARED = "BagIt-Version: 1.0\nTag-File-Character-Encoding: UTF-8\n"
_SPECIFICATION = "https://w3id.org/ro/crate/1.1"
_LINE = re.compile(r"([0-9a-fA-F]{64})[ \t]+\*?(.+)")
_ESCAPED = {"%25": "%", "%0A": "\n", "%0D": "\r"}


@dataclass(frozen=True)
class CrateFile:
    """A file of a crate.

    Attributes
    ----------
    path
        Relative to the crate, with forward slashes.
    sha256, size_bytes
        Of its bytes.
    media_type, description
        For people and repositories.
    made_at
        With time zone; None where it does not matter.
    """

    path: str
    sha256: str
    size_bytes: int
    media_type: str
    description: str
    made_at: datetime | None = None


def metadata(
    name: str, description: str, published: datetime, program_version: str, files: Iterable[CrateFile]
) -> dict[str, Any]:
    """Return the contents of the RO-Crate metadata file."""
    described = [_described(one) for one in files]
    program = {"@id": "#sms_jobs"}
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": name,
        "description": description,
        "datePublished": published.isoformat(),
        "license": "no licence is given; ask whoever made these files",
        "hasPart": [{"@id": one["@id"]} for one in described],
        "mentions": program,
    }
    return {
        "@context": [f"{_SPECIFICATION}/context", {"sha256": "https://schema.org/sha256"}],
        "@graph": [
            {
                "@id": METADATA,
                "@type": "CreativeWork",
                "conformsTo": {"@id": _SPECIFICATION},
                "about": {"@id": "./"},
            },
            root,
            {
                **program,
                "@type": "SoftwareApplication",
                "name": "sms_jobs",
                "softwareVersion": program_version,
            },
            *described,
        ],
    }


def _described(one: CrateFile) -> dict[str, Any]:
    entity: dict[str, Any] = {
        "@id": quote(one.path, safe="/-._~"),
        "@type": "File",
        "name": PurePosixPath(one.path).name,
        "description": one.description,
        "encodingFormat": one.media_type,
        "contentSize": str(one.size_bytes),
        "sha256": one.sha256,
    }
    if one.made_at is not None:
        entity["dateCreated"] = one.made_at.isoformat()
    return entity


def manifest(hashes: Mapping[str, str]) -> str:
    """Return a BagIt manifest: SHA-256 by path relative to the bag."""
    lines = []
    for path, sha256 in sorted(hashes.items()):
        escaped = path.replace("%", "%25").replace("\n", "%0A").replace("\r", "%0D")
        lines.append(f"{sha256}  {escaped}\n")
    return "".join(lines)


def information(description: str, made_at: datetime, sizes: Sequence[int]) -> str:
    """Return the contents of `bag-info.txt`."""
    return (
        f"External-Description: {' '.join(description.split())}\n"
        f"Bagging-Date: {made_at:%Y-%m-%d}\n"
        f"Payload-Oxum: {sum(sizes)}.{len(sizes)}\n"
    )


def read_manifest(text: str) -> dict[str, str]:
    """Return the SHA-256 of every path that a manifest lists.

    Raises
    ------
    InvalidInput
        A line is none of a manifest, names a path that is not inside the payload, or one that was named.
    """
    listed: dict[str, str] = {}
    for where, path, sha256 in _lines(text, MANIFEST):
        parts = PurePosixPath(path).parts
        if parts[0] != PAYLOAD or len(parts) < 2 or ".." in parts or "\0" in path or "\\" in path:
            raise InvalidInput(f"'{path}' in {where} is not a path inside {PAYLOAD}")
        if path in listed or path != "/".join(parts):
            raise InvalidInput(f"'{path}' in {where} is named twice")
        listed[path] = sha256
    return listed


def read_tag_manifest(text: str) -> dict[str, str]:
    """Return the SHA-256 of every file beside the payload that a tag manifest lists.

    Raises `InvalidInput` for a line that is none of a manifest, or names no file beside the payload.
    """
    listed: dict[str, str] = {}
    for where, path, sha256 in _lines(text, TAG_MANIFEST):
        parts = PurePosixPath(path).parts
        if not parts or parts[0] in (PAYLOAD, "/") or ".." in parts or "\0" in path or "\\" in path:
            raise InvalidInput(f"'{path}' in {where} is not a file beside {PAYLOAD}")
        listed[path] = sha256
    return listed


def _lines(text: str, manifest: str) -> Iterator[tuple[str, str, str]]:
    """Yield of each line of a manifest where it is, its path and its SHA-256."""
    for number, line in enumerate(text.splitlines(), 1):
        where = f"line {number} of {manifest}"
        found = _LINE.fullmatch(line)
        if found is None:
            raise InvalidInput(f"{where} is not a checksum and a path; export it again")
        path = re.sub("%(?:25|0A|0D)", lambda escaped: _ESCAPED[escaped[0]], found[2])
        yield where, path, found[1].lower()


def as_text(document: Mapping[str, Any]) -> str:
    """Return JSON as it is written into a crate."""
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"
