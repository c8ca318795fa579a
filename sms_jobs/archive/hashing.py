"""The content hash: what a dataset file says, whatever its bytes and whenever it was written.

It is the SHA-256 of a canonical JSON manifest: for every record, in order, its name, its class, the text of
its plain fields, and of every array the name, type, shape, unit and the SHA-256 of its bytes in C order.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field

from sms_jobs.archive.provenance import digest


@dataclass(frozen=True)
class ArrayDigest:
    """What the manifest says of an array: NumPy's little-endian type string, shape, unit and SHA-256."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    unit: str
    sha256: str


@dataclass
class Manifest:
    """Collects what the content hash covers."""

    records: list[dict[str, object]] = field(default_factory=list)

    def add(self, name: str, record: str, plain: str, arrays: list[ArrayDigest]) -> None:
        """Add one record: its name, the name of its class, its plain fields as JSON, its arrays in order."""
        self.records.append(
            {
                "name": name,
                "record": record,
                "fields": plain,
                "arrays": [
                    {
                        "name": a.name,
                        "dtype": a.dtype,
                        "shape": list(a.shape),
                        "unit": a.unit,
                        "sha256": a.sha256,
                    }
                    for a in arrays
                ],
            }
        )

    def content_hash(self) -> str:
        """Return the SHA-256 of the manifest, in hexadecimal."""
        return digest(json.dumps(self.records, sort_keys=True, separators=(",", ":"), ensure_ascii=False))
