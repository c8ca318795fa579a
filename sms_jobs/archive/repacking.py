"""Writes a dataset file anew with filters that every HDF5 library has; what it says stays the same."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import h5py

from sms_jobs.archive import hdf5
from sms_jobs.archive.damage import readable
from sms_jobs.archive.place import says_full
from sms_jobs.archive.sealing import safe_file, sync
from sms_jobs.errors import StorageFull

GZIP_LEVEL = 4
_FIRST_OF_PLUGINS = 256
"""Numbers of filters below belong to the HDF5 library itself."""


def repack(source: Path, target: Path, where: str) -> None:
    """Copy a dataset file with gzip in place of filters that need a plugin; `where` names it in messages.

    Content hash, provenance and everything for viewers are those of the source.

    Raises
    ------
    ArchiveCorrupt
        When the source cannot be read.
    StorageFull
        When the target's disk has no room for it.
    """
    with (
        readable(where),
        _room_for(where, target.parent),
        h5py.File(source, "r") as old,
        safe_file(target) as raw,
        h5py.File(raw, "w", libver=hdf5.LIBRARY_VERSIONS) as new,
    ):
        _copy_attributes(old, new)
        _copy_group(old, new)
    sync(target)


@contextmanager
def _room_for(where: str, folder: Path) -> Iterator[None]:
    """Say of a full disk that it is full, or it would be taken for damage of what is copied."""
    try:
        yield
    except Exception as error:
        if says_full(error):
            raise StorageFull(
                f"the disk of {folder} has no room for {where}; free some, or write elsewhere"
            ) from error
        raise


def needs_plugin(dataset: Any) -> bool:
    """Say whether a dataset cannot be read without a plugin."""
    plain = dataset.id.get_create_plist()
    return any(plain.get_filter(i)[0] >= _FIRST_OF_PLUGINS for i in range(plain.get_nfilters()))


def _copy_group(old: Any, new: Any) -> None:
    for name, node in old.items():
        if isinstance(node, h5py.Group):
            made = new.create_group(name)
            _copy_attributes(node, made)
            _copy_group(node, made)
        elif needs_plugin(node):
            made = new.create_dataset(
                name,
                shape=node.shape,
                dtype=node.dtype,
                chunks=node.chunks,
                compression="gzip",
                compression_opts=GZIP_LEVEL,
                shuffle=True,
                fletcher32=True,
            )
            _copy_attributes(node, made)
            _copy_contents(node, made)
        else:
            old.copy(node, new, name=name)


def _copy_contents(old: Any, new: Any) -> None:
    """Copy an array some MiB at a time, chunks whole."""
    line = prod(old.shape[1:]) * old.dtype.itemsize
    step = old.chunks[0] * max(1, hdf5.SLAB_BYTES // (old.chunks[0] * line))
    for start in range(0, old.shape[0], step):
        new[start : start + step] = old[start : start + step]


def _copy_attributes(old: Any, new: Any) -> None:
    for name in old.attrs:
        # With its own type, since texts of any length would become texts of some length.
        new.attrs.create(name, old.attrs[name], dtype=old.attrs.get_id(name).dtype)
