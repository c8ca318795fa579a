"""The content hash: what a dataset file says, whatever its bytes and whenever it was written.

It is the SHA-256 of a canonical JSON manifest: for every record, in order, its name, its class, the text of
its plain fields, and of every array the name, type, shape, unit, the SHA-256 of its bytes in C order, and the
CRC-32 of each of its blocks. It stands in the file, so that whoever opens one knows what is to be in it
without reading an array, and compares as much of an array as is read.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from sms_jobs.archive.blocks import Grid, Shape, block_checks

_WORTH_A_THREAD_BYTES = 1 << 20


class ArrayDigest(TypedDict):
    """What the manifest says of an array: NumPy's little-endian type string, shape, unit and SHA-256.

    And the shape of a block, with the CRC-32 of each in C order, 8 hexadecimal digits each.
    """

    name: str
    dtype: str
    shape: list[int]
    unit: str
    sha256: str
    block: list[int]
    checks: str


class RecordDigest(TypedDict):
    """What the manifest says of a record: name, class, plain fields as JSON, and its arrays in order."""

    name: str
    record: str
    fields: str
    arrays: list[ArrayDigest]


def manifest_text(manifest: Sequence[RecordDigest]) -> str:
    """Return the canonical JSON of a manifest; its SHA-256 is the content hash."""
    return json.dumps(manifest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)


def manifest_from(text: str) -> list[RecordDigest]:
    """Return the manifest in a text that has been compared with its content hash."""
    manifest: list[RecordDigest] = json.loads(text)
    return manifest


def checks_in(stated: ArrayDigest) -> tuple[Grid, NDArray[np.uint32]]:
    """Return the blocks of an array, and the CRC-32 of each; `ValueError` where they cannot be its own."""
    grid = Grid(tuple(stated["shape"]), tuple(stated["block"]))
    if len(grid.block) != len(grid.shape) or any(length < 1 for length in grid.block):
        raise ValueError(f"blocks of {grid.block} are none of an array of {grid.shape}")
    table = np.frombuffer(bytes.fromhex(stated["checks"]), ">u4")
    return grid, table.astype(np.uint32).reshape(grid.counts)


class ArrayHash:
    """The digests of an array of which slabs are read or written one after the other, by a thread of its own.

    Hashing costs about as much as packing and unpacking do, and Python lets others go on meanwhile. A slab
    must not change before the next one is given or a digest is asked for.

    Parameters
    ----------
    block
        Shape of a block; those at the end of an axis may be shorter. Slabs begin with a block, and are cut
        along the first axis alone.
    """

    def __init__(self, block: Shape) -> None:
        self._block = block
        self._sha = hashlib.sha256()
        self._checks: list[bytes] = []
        self._thread: threading.Thread | None = None

    def update(self, slab: NDArray[Any]) -> None:
        """Add a slab in C order."""
        self._wait()
        if slab.nbytes < _WORTH_A_THREAD_BYTES:
            self._add(slab)
            return
        self._thread = threading.Thread(target=self._add, args=(slab,), name="hashing")
        self._thread.start()

    def sha256(self) -> str:
        """Return the SHA-256 of all that was added."""
        self._wait()
        return self._sha.hexdigest()

    def checks(self) -> str:
        """Return the CRC-32 of all blocks, as the manifest has it."""
        self._wait()
        return b"".join(self._checks).hex()

    def _add(self, slab: NDArray[Any]) -> None:
        self._sha.update(slab.data)
        self._checks.append(block_checks(slab, self._block).astype(">u4").tobytes())

    def _wait(self) -> None:
        if self._thread is not None:
            self._thread.join()
            self._thread = None
