"""The content hash: what a dataset file says, whatever its bytes and whenever it was written.

It is the SHA-256 of a canonical JSON manifest: for every record, in order, its name, its class, the text of
its plain fields, and of every array the name, type, shape, unit and the SHA-256 of its bytes in C order. It
stands in the file, so that whoever opens one knows what is to be in it without reading an array.

Frames are read in parts, to which no hash of the whole can be compared. They have a table besides, with the
CRC-32 of each block of some frames and rows, which the manifest covers too.
"""

from __future__ import annotations

import hashlib
import json
import threading
import zlib
from collections.abc import Callable, Sequence
from typing import Any, NotRequired

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

_WORTH_A_THREAD_BYTES = 1 << 20


class ArrayDigest(TypedDict):
    """What the manifest says of an array: NumPy's little-endian type string, shape, unit and SHA-256.

    Of frames besides: the SHA-256 of the table of their blocks.
    """

    name: str
    dtype: str
    shape: list[int]
    unit: str
    sha256: str
    blocks: NotRequired[str]


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
        self._meanwhile(lambda: self._sha.update(slab.data), slab.nbytes)

    def hexdigest(self) -> str:
        """Return the digest of all that was added."""
        self._wait()
        return self._sha.hexdigest()

    def _meanwhile(self, work: Callable[[], None], size: int) -> None:
        self._wait()
        if size < _WORTH_A_THREAD_BYTES:
            work()
            return
        self._thread = threading.Thread(target=work, name="hashing")
        self._thread.start()

    def _wait(self) -> None:
        if self._thread is not None:
            self._thread.join()
            self._thread = None


class FramesHash(SlabHash):
    """The SHA-256 of frames and the table of their blocks.

    Parameters
    ----------
    shape
        (frames, rows, columns) of all.
    block
        Frames and rows in a block, from the first on; the last ones may have fewer. Slabs begin with a block.
    """

    def __init__(self, shape: tuple[int, int, int], block: tuple[int, int]) -> None:
        super().__init__()
        self._block = block
        self._table = np.empty(tuple(-(-n // b) for n, b in zip(shape, block, strict=False)), np.uint32)
        self._done = 0

    def update(self, slab: NDArray[Any]) -> None:
        """Add some frames with all their rows."""
        self._meanwhile(lambda: self._add(slab), slab.nbytes)

    def table(self) -> NDArray[np.uint32]:
        """Return the CRC-32 of each block, (blocks of frames, blocks of rows)."""
        self._wait()
        return self._table

    def _add(self, slab: NDArray[Any]) -> None:
        self._sha.update(slab.data)
        checks = block_checks(slab, self._block)
        self._table[self._done : self._done + len(checks)] = checks
        self._done += len(checks)


def block_checks(slab: NDArray[Any], block: tuple[int, int]) -> NDArray[np.uint32]:
    """Return the CRC-32 of the blocks of a slab (frames, rows, columns) that begins with a block."""
    depth, height = block
    count, rows, _ = slab.shape
    found = np.zeros((-(-count // depth), -(-rows // height)), np.uint32)
    for band in range(found.shape[1]):
        within = slab[:, band * height : (band + 1) * height]
        for index in range(count):
            frame = np.ascontiguousarray(within[index])
            found[index // depth, band] = zlib.crc32(frame.data, int(found[index // depth, band]))
    return found
