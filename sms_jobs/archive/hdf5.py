"""The HDF5 file itself: NeXus groups, filters and chunks; written in one pass, read back as records.

`docs/archive_format.md` describes the same from the outside.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC
from math import prod
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from sms_jobs.archive.codec import checked_array, layout_of, plain_to_json
from sms_jobs.archive.form import FORMAT, FORMAT_VERSION, LARGEST_TEXT_BYTES
from sms_jobs.archive.hashing import ArrayDigest, ArrayHash, RecordDigest, manifest_text
from sms_jobs.archive.limits import LARGEST_SLAB_BYTES
from sms_jobs.archive.provenance import Provenance, digest, provenance_to_json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.quantity import Quantity, quantities_of
from sms_jobs.records.reasons import Reason

LIBRARY_VERSIONS = ("v108", "v110")
"""Newer object formats cannot be read by the HDF5 1.10 and 1.12 of people's tools."""

CHUNK_BYTES = 1 << 20
SLAB_BYTES = 4 << 20
FRAMES_IN_CHUNK = 4
ROWS_IN_CHUNK = 64
FIELDS = "record_fields"
BLOCK = "block"
PROCESS = "process"
MANIFEST = "manifest"
_SCALAR = h5py.h5s.create(h5py.h5s.SCALAR)
_TEXT = h5py.h5t.py_create(h5py.string_dtype(), logical=True)
_WITHOUT_TIMES = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
_WITHOUT_TIMES.set_obj_track_times(False)
_RESERVED = {PROCESS, MANIFEST, "title", "start_time", "definition"}


def chunk_shape(shape: tuple[int, ...], itemsize: int, streamed: bool) -> tuple[int, ...]:
    """Return chunks of at most 1 MiB: whole rows of one image, or row slabs over several frames.

    A slab (4, 64, columns) of a stack lets ranging read some rows of every frame, and a viewer one frame,
    without reading much else.
    """
    if streamed:
        frames, rows, columns = (max(1, length) for length in shape)
        depth = min(FRAMES_IN_CHUNK, frames)
        slab = max(1, CHUNK_BYTES // (depth * columns * itemsize))
        return depth, min(ROWS_IN_CHUNK, rows, slab), columns
    chunks: list[int] = []
    room = CHUNK_BYTES // itemsize
    for length in reversed(shape):
        chunks.append(max(1, min(length, room)))
        room //= chunks[-1]
    return tuple(reversed(chunks))


def _create(group: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any, streamed: bool) -> Any:
    """Create a dataset, with filters unless it is empty or a scalar."""
    dtype = np.dtype(dtype)
    if 0 in shape or not shape:
        return group.create_dataset(name, shape=shape, dtype=dtype)
    if dtype.kind == "f":
        # Level 1: twice as fast as 3 on noisy fields, and as small within 3 %.
        packing = hdf5plugin.Blosc2(cname="zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE)
    else:
        packing = hdf5plugin.Bitshuffle(cname="lz4")
    return group.create_dataset(
        name,
        shape=shape,
        dtype=dtype,
        chunks=chunk_shape(shape, dtype.itemsize, streamed),
        fletcher32=True,
        **packing,
    )


def _write_stack(dataset: Any, stack: Any, hashed: ArrayHash) -> None:
    """Write and hash frames, a few in memory at a time."""
    count, rows, columns = stack.shape
    for start in range(0, count, FRAMES_IN_CHUNK):
        stop = min(start + FRAMES_IN_CHUNK, count)
        slab = np.empty((stop - start, rows, columns), dataset.dtype)
        for index in range(start, stop):
            slab[index - start] = stack.frame(index)
        hashed.update(slab)
        dataset[start:stop] = slab


def _attach(node: Any, attribute: str, text: str | Sequence[str]) -> None:
    """Attach a text or a list of names, which may be empty.

    By HDF5's own interface: h5py's `attrs` asks first what is there, and makes the type anew for each, which
    takes twice as long, and a small file is mostly attributes.
    """
    values = np.array(text, object)
    space = _SCALAR if values.ndim == 0 else h5py.h5s.create_simple(values.shape)
    h5py.h5a.create(node.id, attribute.encode(), _TEXT, space).write(values)


def _describe(dataset: Any, quantity: Quantity) -> None:
    """Attach unit, meaning, axes and the names of components and flags."""
    _attach(dataset, "units", quantity.unit)
    _attach(dataset, "long_name", f"{quantity.meaning} [{quantity.unit}]")
    _attach(dataset, "meaning", quantity.meaning)
    _attach(dataset, "axes", quantity.axes)
    if quantity.components:
        _attach(dataset, "components", quantity.components)
    if quantity.is_image:
        _attach(dataset, "interpretation", "image")
    if quantity.unit == "bit":
        _attach(dataset, "flag_names", [str(flag.name) for flag in Reason])
        dataset.attrs["flag_masks"] = np.array([flag.value for flag in Reason], np.uint32)


def _text(group: h5py.Group, name: str, text: str) -> None:
    """Write a text of fixed length: viewers show it, and it lies in one place of the file."""
    raw = text.encode() or b"\0"
    kind = h5py.h5t.py_create(h5py.string_dtype("utf-8", len(raw)), logical=True)
    dataset = h5py.h5d.create(group.id, name.encode(), kind, _SCALAR, _WITHOUT_TIMES)
    dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, np.array(raw, np.bytes_), kind)


def _plot_as_nxdata(group: h5py.Group, written: Mapping[str, tuple[Any, Quantity]]) -> None:
    """Say what a viewer shows first: the first image, or the first value over points."""
    images = [n for n, (_, quantity) in written.items() if quantity.is_image]
    points = [n for n, (_, quantity) in written.items() if quantity.axes == ("point",)]
    if images:
        signal = images[0]
        shape = written[signal][0].shape
        axes = ["."] * (len(shape) - 2) + ["row", "column"]
        for axis, length in zip(axes[-2:], shape[-2:], strict=True):
            places = group.create_dataset(axis, data=np.arange(length, dtype=np.int32))
            _attach(places, "units", "px")
            _attach(places, "long_name", f"{axis} [px]")
        others = [n for n in images[1:] if written[n][0].shape == shape]
        if others:
            _attach(group, "auxiliary_signals", others)
    elif {"x", "y"} < set(points) and written["x"][0].size:
        signal, axes = next(n for n in points if n not in ("x", "y", "region")), ["x", "y"]
    else:
        _attach(group, "NX_class", "NXcollection")
        return
    _attach(group, "NX_class", "NXdata")
    _attach(group, "signal", signal)
    _attach(group, "axes", axes)


def _write_record(entry: h5py.Group, name: str, record: Any) -> RecordDigest:
    """Write one record as a group of the entry; return what the manifest says of it."""
    layout = layout_of(type(record))
    if not name.isidentifier() or name in _RESERVED:
        raise InvalidInput(f"'{name}' cannot be the name of a record in a file")
    group = entry.create_group(name)
    arrays: list[ArrayDigest] = []
    written: dict[str, tuple[Any, Quantity]] = {}
    quantities = quantities_of(record)
    for field_name, field in layout.arrays.items():
        value = getattr(record, field_name)
        if value is None and field.optional:
            continue
        array = checked_array(f"{name}.{field_name}", field, value)
        quantity = quantities[field_name]
        dataset = _create(group, field_name, array.shape, array.dtype, field.streamed)
        _describe(dataset, quantity)
        block = chunk_shape(array.shape, np.dtype(array.dtype).itemsize, field.streamed)
        hashed = ArrayHash(block)
        if field.streamed:
            _write_stack(dataset, array, hashed)
        else:
            hashed.update(array)
            dataset[...] = array
        dataset.attrs[BLOCK] = np.array(block, np.int64)
        _attach(dataset, "sha256", hashed.sha256())
        arrays.append(_digest_of(field_name, dataset, quantity.unit, block, hashed))
        written[field_name] = dataset, quantity
    plain = plain_to_json(record)
    _attach(group, "record", type(record).__name__)
    _attach(group, "arrays", [described["name"] for described in arrays])
    _text(group, FIELDS, plain)
    _plot_as_nxdata(group, written)
    return {"name": name, "record": type(record).__name__, "fields": plain, "arrays": arrays}


def _write_process(entry: h5py.Group, provenance: Provenance) -> None:
    """Write the provenance: NeXus' own fields for any reader, and all of it as JSON for this program."""
    group = entry.create_group(PROCESS)
    _attach(group, "NX_class", "NXprocess")
    everything = provenance_to_json(provenance)
    parts = json.loads(everything)
    texts = {
        "program": "sms_jobs",
        "version": provenance.program_version,
        "date": provenance.created_at.astimezone(UTC).isoformat(),
        "subject": str(provenance.subject),
        "parameters": json.dumps(parts["parameters"]),
        "inputs": json.dumps(parts["inputs"]),
        **{key: str(parts[key]) for key in ("kind", "kind_version", "job_id", "attempt", "host", "operator")},
        "provenance": everything,
    }
    for name, text in texts.items():
        _text(group, name, text)
    _attach(group, "sha256", digest(everything))


def write(file: h5py.File, records: Mapping[str, Any], provenance: Provenance) -> str:
    """Fill a new file with records and their provenance; return the content hash.

    The first record that can be plotted is what viewers show when they open the file.
    """
    if not records:
        raise InvalidInput(f"there is no record to seal for {provenance.subject}")
    root = file["/"]
    about = {
        "NX_class": "NXroot",
        "default": "entry",
        "creator": f"sms_jobs {provenance.program_version}",
        "file_time": provenance.created_at.astimezone(UTC).isoformat(),
        "format": FORMAT,
    }
    for name, text in about.items():
        _attach(root, name, text)
    root.attrs["format_version"] = FORMAT_VERSION
    entry = file.create_group("entry")
    _attach(entry, "NX_class", "NXentry")
    _attach(entry, "records", list(records))
    _text(entry, "title", f"{provenance.kind} of {provenance.subject}")
    _text(entry, "start_time", provenance.created_at.astimezone(UTC).isoformat())
    manifest = manifest_text([_write_record(entry, name, one) for name, one in records.items()])
    _text(entry, MANIFEST, manifest)
    plotted = [name for name in records if entry[name].attrs["NX_class"] == "NXdata"]
    _attach(entry, "default", next(iter(plotted or records)))
    _write_process(entry, provenance)
    _attach(root, "content_hash", digest(manifest))
    return digest(manifest)


def _slabs(dataset: Any, block: Sequence[int]) -> Iterator[NDArray[Any]]:
    """Yield a dataset in C order, some MiB at a time and blocks whole."""
    if not dataset.shape or 0 in dataset.shape:
        yield np.ascontiguousarray(dataset[()]).reshape(dataset.shape)
        return
    line = prod(dataset.shape[1:]) * dataset.dtype.itemsize
    step = block[0] * max(1, SLAB_BYTES // (block[0] * line))
    for start in range(0, dataset.shape[0], step):
        yield np.ascontiguousarray(dataset[start : start + step])


def _digest_of(name: str, dataset: Any, unit: str, block: Sequence[int], hashed: ArrayHash) -> ArrayDigest:
    """Return what the manifest says of an array that was hashed as a whole."""
    return {
        "name": name,
        "dtype": dataset.dtype.str,
        "shape": list(dataset.shape),
        "unit": unit,
        "sha256": hashed.sha256(),
        "block": list(block),
        "checks": hashed.checks(),
    }


def _found_digest(name: str, dataset: Any) -> ArrayDigest:
    """Read a whole array and return what the manifest has to say of it; `ValueError` if its own hash lies."""
    block = _block_of(dataset)
    hashed = ArrayHash(block)
    for slab in _slabs(dataset, block):
        hashed.update(slab)
    if dataset.attrs["sha256"] != hashed.sha256():
        raise ValueError(f"the values of {name} have another hash than is written beside them")
    return _digest_of(name, dataset, dataset.attrs["units"], block, hashed)


def _block_of(dataset: Any) -> tuple[int, ...]:
    """Return the shape of a block; `ValueError` where it cannot be that of this array, or is too large."""
    block = tuple(int(length) for length in dataset.attrs[BLOCK])
    if len(block) != dataset.ndim or any(length < 1 for length in block):
        raise ValueError(f"blocks of {block} are none of an array of {dataset.shape}")
    at_once = prod((*block[:1], *dataset.shape[1:])) * dataset.dtype.itemsize
    if min(at_once, dataset.nbytes) > LARGEST_SLAB_BYTES:
        raise ValueError(f"its blocks of {block} cannot be read in pieces of {LARGEST_SLAB_BYTES >> 20} MiB")
    return block


def read_text(dataset: Any) -> str:
    """Read a text written by `_text`; raise `ValueError` when it is none, or too long."""
    if dataset.shape != () or dataset.dtype.kind != "S" or dataset.dtype.itemsize > LARGEST_TEXT_BYTES:
        raise ValueError(f"a text of at most {LARGEST_TEXT_BYTES >> 20} MiB is missing in it")
    value: bytes = dataset[()]
    return value.decode()


def _found_record(name: str, group: Any) -> RecordDigest:
    return {
        "name": name,
        "record": group.attrs["record"],
        "fields": read_text(group[FIELDS]),
        "arrays": [_found_digest(array, group[array]) for array in group.attrs["arrays"]],
    }


def found_manifest(file: h5py.File) -> str:
    """Read everything in a file and return the manifest that it has to have."""
    entry = file["entry"]
    return manifest_text([_found_record(name, entry[name]) for name in entry.attrs["records"]])


def stored_manifest(file: h5py.File) -> str:
    """Return the manifest that stands in a file; its SHA-256 is the content hash."""
    return read_text(file["entry"][MANIFEST])


def provenance_is_whole(file: h5py.File) -> bool:
    """Say whether the provenance is what was written; the content hash does not cover it."""
    group = file["entry"][PROCESS]
    return bool(digest(read_text(group["provenance"])) == group.attrs["sha256"])
