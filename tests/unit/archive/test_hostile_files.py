"""Files that somebody brought are read within limits, and never lead anywhere else."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest
from support.sealing import provenance

from sms_jobs.archive import Archive, Checker, Sealed, limits
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.jobs.keeping import verification
from sms_jobs.jobs.rebuilding import reindexing


@pytest.fixture(scope="module")
def checker() -> Iterator[Checker]:
    with Checker() as reader:
        yield reader


def tampered(archive: Archive, sealed: Sealed, change: Callable[[Any], object]) -> None:
    """Change a sealed file as somebody would who wants to do harm."""
    file = archive.store.path(sealed.path)
    file.chmod(0o644)
    with h5py.File(file, "r+") as opened:
        change(opened)


def replaced(name: str, **how: Any) -> Callable[[Any], None]:
    """Return a change that puts another array in the place of the texture."""

    def change(opened: Any) -> None:
        group = opened["entry/measurement"]
        kept = dict(group[name].attrs)
        del group[name]
        made = group.create_dataset(name, **how)
        made.attrs.update(kept)

    return change


def soft(opened: Any) -> None:
    opened["entry/measurement/more"] = h5py.SoftLink("/entry")


def external(opened: Any) -> None:
    del opened["entry/measurement/texture"]
    opened["entry/measurement/texture"] = h5py.ExternalLink("/etc/passwd", "/texture")


def virtual(opened: Any) -> None:
    del opened["entry/measurement/texture"]
    layout = h5py.VirtualLayout((150, 90), np.uint16)
    layout[:] = h5py.VirtualSource("other.h5", "texture", (150, 90))
    opened["entry/measurement"].create_virtual_dataset("texture", layout)


def outside(opened: Any) -> None:
    del opened["entry/measurement/texture"]
    raw = [(b"/etc/passwd", 0, 100)]
    opened["entry/measurement"].create_dataset("texture", (100,), np.uint8, external=raw)


def references(opened: Any) -> None:
    data = np.array([opened["entry"].ref], dtype=h5py.ref_dtype)
    replaced("texture", data=data)(opened)


def many(opened: Any) -> None:
    folder = opened.create_group("many")
    for number in range(limits.MOST_OBJECTS):
        folder[str(number)] = opened["entry"]


def named(opened: Any) -> None:
    opened["entry/type"] = np.dtype("f8")


def labelled(opened: Any) -> None:
    for number in range(limits.MOST_ATTRIBUTES + 1):
        opened["entry"].attrs[f"a{number}"] = 1


BOMB = hdf5plugin.Blosc2(cname="zstd", clevel=1, filters=hdf5plugin.Blosc2.BITSHUFFLE)
TAMPERED: dict[str, tuple[Callable[[Any], object], str]] = {
    "soft link": (soft, "link to elsewhere"),
    "external link": (external, "link to elsewhere"),
    "virtual array": (virtual, "lies in another file"),
    "external array": (outside, "lies in another file"),
    "references": (references, "neither numbers nor text"),
    "texts of any length": (
        replaced("texture", data=np.array(["a"], object), dtype=h5py.string_dtype()),
        "neither numbers nor text",
    ),
    "many objects": (many, "more than 10000 objects"),
    "named type": (named, "neither a group nor an array"),
    "many attributes": (labelled, "more than 64 attributes"),
    "many axes": (replaced("texture", shape=(1,) * 9, dtype="u2"), "9 axes"),
    # Nothing of these is stored: HDF5 makes it up while it is read.
    "large array": (replaced("texture", shape=(1 << 20, 1 << 12), dtype="f4"), "more than 4096 MiB"),
    "large line": (replaced("texture", shape=(2, 1 << 15, 1 << 15), dtype="u2"), "pieces of 1024 MiB"),
    "large contents": (replaced("texture", shape=(1 << 14, 1 << 10, 1 << 10), dtype="u2"), "in a file of"),
    "large chunk": (
        replaced("texture", shape=(1 << 13, 1 << 13), dtype="f4", chunks=(1 << 13, 1 << 13), **BOMB),
        "chunks of more than 64 MiB",
    ),
    "large text": (
        replaced("record_fields", shape=(), dtype=h5py.string_dtype("utf-8", limits.LARGEST_TEXT_BYTES + 1)),
        "text of 64 MiB",
    ),
    "no text": (replaced("record_fields", data=np.arange(3)), "is missing"),
}


@pytest.mark.parametrize(("change", "why"), TAMPERED.values(), ids=TAMPERED.keys())
def test_what_asks_too_much_or_leads_elsewhere_is_refused(
    change: Callable[[Any], object], why: str, archive: Archive, sealed: Sealed, checker: Checker
) -> None:
    tampered(archive, sealed, change)
    with pytest.raises(ArchiveCorrupt, match=why):
        archive.examine(sealed.path, checker)


def test_a_group_within_itself_is_walked_once(archive: Archive, sealed: Sealed, checker: Checker) -> None:
    tampered(archive, sealed, lambda opened: opened["entry"].__setitem__("again", opened["entry"]))
    archive.verify(sealed.path, sealed.content_hash, checker)


@pytest.mark.parametrize("attribute", ["records", "format_version"])
def test_attributes_of_another_type_are_no_crash(
    attribute: str, archive: Archive, sealed: Sealed, checker: Checker
) -> None:
    def change(opened: Any) -> None:
        place = opened["entry"] if attribute == "records" else opened
        place.attrs[attribute] = 1.5 if attribute == "records" else "one"

    tampered(archive, sealed, change)
    with pytest.raises(ArchiveCorrupt):
        archive.examine(sealed.path, checker)
    with pytest.raises(ArchiveCorrupt), archive.open(sealed):
        pass


def document(archive: Archive) -> Sealed:
    return archive.seal_document("page.txt", "text/plain", lambda p: p.write_text("1"), provenance())


@pytest.mark.parametrize("what", ["deep", "large", "pipe", "none", "other", "altered"])
def test_what_lies_beside_a_document_is_read_with_care(what: str, archive: Archive, checker: Checker) -> None:
    sealed = document(archive)
    beside = archive.store.path(f"{sealed.path}.provenance.json")
    told = json.loads(beside.read_text())
    beside.unlink()
    if what == "deep":
        beside.write_text('{"provenance": ' + "[" * 100_000)
    elif what == "large":
        with beside.open("wb") as stream:
            stream.truncate(limits.LARGEST_TEXT_BYTES + 1)
    elif what == "pipe":
        os.mkfifo(beside)
    elif what == "other":
        beside.write_text("[]")
    elif what == "altered":
        told["provenance"]["operator"] = "somebody else"
        beside.write_text(json.dumps(told))
    with pytest.raises(ArchiveCorrupt, match="the provenance of"):
        archive.examine(sealed.path, checker)
    with pytest.raises(ArchiveCorrupt, match="the provenance of"):
        archive.verify_provenance(sealed.path, sealed.content_hash)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_files_are_found_by_are_finite(value: float, archive: Archive, checker: Checker) -> None:
    sealed = archive.seal_document(
        "page.txt", "text/plain", lambda p: p.write_text("1"), provenance(statistics={"mean": 1.0})
    )
    beside = archive.store.path(f"{sealed.path}.provenance.json")
    told = json.loads(beside.read_text())
    del told["sha256"]
    told["provenance"]["statistics"]["mean"] = value
    beside.chmod(0o644)
    beside.write_text(json.dumps(told))
    with pytest.raises(ArchiveCorrupt, match=r"mean of .* is not finite"):
        archive.examine(sealed.path, checker)


def test_documents_of_older_programs_are_read(archive: Archive, checker: Checker) -> None:
    sealed = document(archive)
    beside = archive.store.path(f"{sealed.path}.provenance.json")
    told = json.loads(beside.read_text())
    del told["sha256"]
    beside.chmod(0o644)
    beside.write_text(json.dumps(told))
    assert archive.examine(sealed.path, checker).provenance == provenance()


def test_every_flipped_bit_beside_a_document_is_noticed_or_changes_nothing(
    archive: Archive, checker: Checker
) -> None:
    sealed = document(archive)
    good = archive.examine(sealed.path, checker)
    beside = archive.store.path(f"{sealed.path}.provenance.json")
    data = beside.read_bytes()
    beside.chmod(0o644)
    noticed = 0
    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        beside.write_bytes(flipped)
        try:
            assert archive.examine(sealed.path, checker) == good, bit
        except ArchiveCorrupt:
            noticed += 1
    # All but spaces between the parts, and names of what is not read.
    assert noticed > 0.7 * 8 * len(data)


def test_a_link_out_of_the_archive_spoils_nothing_else(
    archive: Archive, sealed: Sealed, tmp_path: Path
) -> None:
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'catalogue.sqlite'}", create=True)
    schema.upgrade(catalogue)
    leading_out = sealed.path.replace("-1.h5", "-2.h5")
    (archive.store.root / leading_out).symlink_to("/etc/passwd")
    paths = reindexing.unknown_files(catalogue, archive)
    told = {one.path: one for one in reindexing.reindex(catalogue, archive, paths)}
    assert told[leading_out].outcome == "refused"
    assert "through a link" in told[leading_out].detail
    assert told[sealed.path].outcome == "no-campaign"
    assert {f.path: f.problem for f in verification.check_unknown(catalogue, archive)} == {
        leading_out: "unknown",
        sealed.path: "unknown",
    }
    catalogue.close()
