"""What a dataset file may ask of whoever reads it: files are brought by strangers too.

Everything is judged by what the file declares, before any of it is read. Honest files stay far below: a
recording of a 20 megapixel camera has arrays of 0.2 GB, and frames are read a few at a time.
"""

from __future__ import annotations

from math import prod
from typing import Any

import h5py

from sms_jobs.archive.form import LARGEST_TEXT_BYTES

MIB = 1 << 20
MOST_OBJECTS = 10_000
MOST_AXES = 8
MOST_ATTRIBUTES = 64
"""Of one object; they are stored as they are, so that the file's size limits theirs."""
LARGEST_CHUNK_BYTES = 64 * MIB
LARGEST_SLAB_BYTES = 1024 * MIB
"""Of what is in memory at a time while an array is read piece by piece."""
LARGEST_ARRAY_BYTES = 4096 * MIB
"""Of an array that is read as a whole; frames are not."""
LARGEST_CONTENTS_BYTES = 16 * 1024 * MIB
MOST_EXPANSION = 1000
"""Contents may be more than `LARGEST_CONTENTS_BYTES` when they are at most so many times the file's size."""
_PLAIN = frozenset("biufS")


def refuse_excess(file: h5py.File) -> None:
    """Look through a file before it is read; raise `ValueError`, naming the limit, for what is over one.

    Links that lead elsewhere, virtual and external datasets, and types that are no number or text are
    refused too: nothing that this program writes has them, and they would have other files read.
    """
    # By HDF5's own interface: h5py's groups look up each name twice and make an object of each, which takes
    # four times as long, and each file is looked through as it is sealed.
    size = file.id.get_filesize()
    most = max(LARGEST_CONTENTS_BYTES, MOST_EXPANSION * size)
    root = h5py.h5g.open(file.id, b"/")
    _refuse_attributes("/", root)
    seen: set[int] = {h5py.h5o.get_info(root).addr}
    pending: list[tuple[str, Any]] = [("", root)]
    links, total = 0, 0
    while pending:
        above, group = pending.pop()
        for own in group:
            name = f"{above}/{own.decode(errors='replace')}"
            links += 1
            if links > MOST_OBJECTS:
                raise ValueError(f"it has more than {MOST_OBJECTS} objects")
            if group.links.get_info(own).type != h5py.h5l.TYPE_HARD:
                raise ValueError(f"'{_short(name)}' is a link to elsewhere")
            node = h5py.h5o.open(group, own)
            address = h5py.h5o.get_info(node).addr
            if address in seen:
                continue
            seen.add(address)
            _refuse_attributes(name, node)
            if isinstance(node, h5py.h5g.GroupID):
                pending.append((name, node))
                continue
            total += _size_of(name, node)
            if total > most:
                raise ValueError(
                    f"it declares more than {most / MIB:.0f} MiB in a file of {size / MIB:.1f} MiB"
                )


def _refuse_attributes(name: str, node: Any) -> None:
    if h5py.h5a.get_num_attrs(node) > MOST_ATTRIBUTES:
        raise ValueError(f"'{_short(name)}' has more than {MOST_ATTRIBUTES} attributes")


def _size_of(name: str, dataset: Any) -> int:
    """Return the bytes that a dataset declares; raise `ValueError` when it is not to be read."""
    what = f"'{_short(name)}'"
    if not isinstance(dataset, h5py.h5d.DatasetID):
        raise ValueError(f"{what} is neither a group nor an array")  # noqa: TRY004
    plain = dataset.get_create_plist()
    layout = plain.get_layout()
    if layout == h5py.h5d.VIRTUAL or plain.get_external_count():
        raise ValueError(f"{what} lies in another file")
    shape, dtype = dataset.shape, dataset.dtype
    if shape is None or dtype.kind not in _PLAIN or dtype.subdtype is not None:
        raise ValueError(f"{what} holds {dtype}, which is neither numbers nor text")
    if len(shape) > MOST_AXES:
        raise ValueError(f"{what} has {len(shape)} axes, more than {MOST_AXES}")
    size = int(prod(shape) * dtype.itemsize)
    if dtype.kind == "S" and size > LARGEST_TEXT_BYTES:
        raise ValueError(f"{what} declares a text of {size / MIB:.0f} MiB")
    chunks = plain.get_chunk() if layout == h5py.h5d.CHUNKED else None
    if chunks is not None and prod(chunks) * dtype.itemsize > LARGEST_CHUNK_BYTES:
        raise ValueError(f"{what} has chunks of more than {LARGEST_CHUNK_BYTES / MIB:.0f} MiB")
    if shape and size:
        at_once = (1 if chunks is None else chunks[0]) * prod(shape[1:]) * dtype.itemsize
        if min(at_once, size) > LARGEST_SLAB_BYTES:
            raise ValueError(f"{what} cannot be read in pieces of {LARGEST_SLAB_BYTES / MIB:.0f} MiB")
    frames = dtype.kind == "u" and len(shape) == 3
    if not frames and size > LARGEST_ARRAY_BYTES:
        raise ValueError(
            f"{what} declares {size / MIB:.0f} MiB, more than {LARGEST_ARRAY_BYTES / MIB:.0f} MiB"
        )
    return size


def _short(name: str) -> str:
    return name if len(name) <= 80 else f"{name[:77]}..."
