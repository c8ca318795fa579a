"""A file of the archive as a group of Zarr, version 3: nothing is stored, chunks are read when asked for.

A record is a group, and each of its arrays an array whose chunks are the blocks in which the archive compares
it. Specification: https://zarr-specs.readthedocs.io/en/latest/v3/core/
"""

from __future__ import annotations

import gzip
import json
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_jobs.app.fields.arrays import dataset_view
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import NotFound
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.archive.arrays import StoredArray
    from sms_jobs.archive.dataset import ArchivedDataset

METADATA = "zarr.json"
_LEVEL = 1
"""Of gzip: higher ones take up to twice the time, for 3 % of the size."""
_CHUNK = re.compile(r"c((/\d{1,9})*)")
_GROUP = {"zarr_format": 3, "node_type": "group"}


@use_case(Right.READ)
def zarr_entry(services: Services, key: str, path: str, *, packed: bool = False) -> bytes:
    """Return what stands under a name in the Zarr group of a file: JSON, or a chunk.

    Parameters
    ----------
    path
        `zarr.json`, `RECORD/zarr.json`, `RECORD/ARRAY/zarr.json` or `RECORD/ARRAY/c/0/1`.
    packed
        Whether chunks are packed by gzip, as the metadata says then: for a network that is slower than
        packing is.

    Raises
    ------
    NotFound
        There is no such file, or nothing under that name.
    InvalidInput
        It is a document.
    ArchiveCorrupt
        It is not as it was sealed.
    """
    view = dataset_view(services, key)
    with services.archive.open(view) as dataset:
        record, _, rest = path.partition("/")
        name, _, inner = rest.partition("/")
        if path == METADATA:
            about = _root(dataset, packed) | {"attributes": {"file": view.id, "subject": view.subject}}
            return _json(about)
        if rest == METADATA and record in dataset.names:
            return _json(_group(dataset, record))
        if inner == METADATA and name in dataset.describe().get(record, {}):
            return _json(_array(dataset, record, name, packed))
        chunk = _CHUNK.fullmatch(inner)
        if chunk is None or record not in dataset.names:
            raise _nothing(path)
        with dataset.array(record, name) as stored:
            index = tuple(map(int, chunk[1].split("/")[1:]))
            counts = stored.grid.counts
            if len(index) != len(counts) or any(i >= n for i, n in zip(index, counts, strict=True)):
                raise _nothing(path)
            whole = _whole_chunk(stored, index)
            # Without the time of packing, so that the same chunk is the same bytes.
            return gzip.compress(whole, _LEVEL, mtime=0) if packed else whole


def _nothing(path: str) -> NotFound:
    return NotFound(f"there is nothing named {path!r:.200} in the Zarr group of the file; see its zarr.json")


def _json(about: dict[str, Any]) -> bytes:
    return json.dumps(about, ensure_ascii=False).encode()


def _root(dataset: ArchivedDataset, packed: bool) -> dict[str, Any]:
    """Return a group that says of everything in it what it is, since nobody can list it."""
    known = {}
    for record, arrays in dataset.describe().items():
        known[record] = _group(dataset, record)
        for name in arrays:
            known[f"{record}/{name}"] = _array(dataset, record, name, packed)
    inline = {"kind": "inline", "must_understand": False, "metadata": known}
    return _GROUP | {"consolidated_metadata": inline}


def _group(dataset: ArchivedDataset, record: str) -> dict[str, Any]:
    kind, plain = dataset.parts_of(record)
    return _GROUP | {"attributes": {"record": kind, "fields": plain}}


def _array(dataset: ArchivedDataset, record: str, name: str, packed: bool) -> dict[str, Any]:
    about = dataset.describe()[record][name]
    with dataset.array(record, name) as stored:
        shape, block, dtype = stored.shape, stored.grid.block, stored.dtype
    attributes = {"units": about["unit"], "long_name": about["meaning"], "components": about["components"]}
    codecs: list[dict[str, Any]] = [{"name": "bytes", "configuration": {"endian": "little"}}]
    if packed:
        codecs.append({"name": "gzip", "configuration": {"level": _LEVEL}})
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": list(shape),
        "data_type": dtype.name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(block)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": {"f": "NaN", "b": False}.get(dtype.kind, 0),
        "codecs": codecs,
        "dimension_names": about["axes"],
        "attributes": attributes,
    }


def _whole_chunk(stored: StoredArray, index: tuple[int, ...]) -> bytes:
    """Return a block as a chunk: of one size everywhere, filled up at the end of an axis."""
    block = stored.block(index)
    fill = np.nan if stored.dtype.kind == "f" else 0
    chunk = np.full(stored.grid.block, fill, stored.dtype)
    chunk[tuple(slice(0, n) for n in block.shape)] = block
    return chunk.tobytes()
