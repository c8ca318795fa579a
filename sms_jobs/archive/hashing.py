"""The content hash: what a dataset file says, whatever its bytes and whenever it was written.

It is the SHA-256 of a canonical JSON manifest: for every record, in order, its name, its class, the text of
its plain fields, and of every array the name, type, shape, unit and the SHA-256 of its bytes in C order.
"""

from __future__ import annotations

import hashlib
import json
import threading
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from sms_jobs.archive.provenance import digest

_WORTH_A_THREAD_BYTES = 1 << 20


class SlabHash:
    """The SHA-256 of slabs that are read or written one after the other, taken by a thread of its own.

    Hashing costs about as much as packing and unpacking do, and Python lets others go on meanwhile. A slab
    must not change before the next one is given or the digest is asked for.
    """

    def __init__(self) -> None:
        self._sha = hashlib.sha256()
        self._thread: threading.Thread | None = None

    def update(self, slab: NDArray[Any]) -> None:
        """Add the bytes of an array in C order."""
        self._wait()
        if slab.nbytes < _WORTH_A_THREAD_BYTES:
            self._sha.update(slab.data)
            return
        self._thread = threading.Thread(target=self._sha.update, args=(slab.data,), name="hashing")
        self._thread.start()

    def hexdigest(self) -> str:
        """Return the digest of all that was added."""
        self._wait()
        return self._sha.hexdigest()

    def _wait(self) -> None:
        if self._thread is not None:
            self._thread.join()
            self._thread = None


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
