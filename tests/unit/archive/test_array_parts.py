"""Parts of arrays: the same as of the whole, and what was sealed, however they lie in blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
from support.sealing import measurement, point_cloud, provenance

from sms_jobs.archive import Archive, Sealed, blocks
from sms_jobs.archive.arrays import stored_array
from sms_jobs.archive.blocks import Grid, lengths, pieces
from sms_jobs.archive.hashing import ArrayDigest
from sms_jobs.errors import ArchiveCorrupt, NotFound
from sms_jobs.records.fields import Surface


def large(rng: np.random.Generator) -> Surface:
    """Return a surface whose arrays have several blocks, the last of which are shorter."""
    image = (301, 700)
    cloud = point_cloud(rng)
    return replace(
        cloud,
        position=rng.normal(size=(3, *image)),
        covariance=None,
        ray_gap=rng.normal(size=image).astype(np.float32),
        reason=np.zeros(image, np.uint32),
    )


PARTS = [
    (slice(0, 3, 1), slice(0, 301, 1), slice(0, 700, 1)),
    (slice(1, 2, 1), slice(180, 190, 1), slice(0, 700, 4)),
    (slice(0, 3, 2), slice(3, 301, 7), slice(699, 700, 1)),
    (slice(2, 3, 1), slice(5, 5, 1), slice(0, 10, 1)),
]


@pytest.mark.parametrize("part", PARTS)
def test_a_part_is_that_of_the_whole(archive: Archive, rng: np.random.Generator, part: Any) -> None:
    record = large(rng)
    sealed = archive.seal_dataset({"surface": record}, provenance())
    with archive.open(sealed) as dataset, dataset.array("surface", "position") as stored:
        assert stored.grid.counts == (3, 2, 1)
        np.testing.assert_array_equal(stored.read(part), record.position[part])


def test_a_part_of_frames_is_that_of_the_whole(archive: Archive, rng: np.random.Generator) -> None:
    record = measurement(rng)
    sealed = archive.seal_dataset({"measurement": record}, provenance())
    part = (slice(1, 6, 2), slice(60, 130, 3), slice(10, 90, 1))
    with archive.open(sealed) as dataset, dataset.array("measurement", "frames") as stored:
        np.testing.assert_array_equal(stored.read(part), record.frames.rows(0, 150)[part])


def test_pieces_follow_one_another_and_are_small(
    archive: Archive, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocks, "PIECE_BYTES", 100_000)
    record = large(rng)
    sealed = archive.seal_dataset({"surface": record}, provenance())
    with archive.open(sealed) as dataset, dataset.array("surface", "position") as stored:
        for part in PARTS:
            found = list(stored.pieces(part))
            assert all(piece.nbytes <= 100_000 for piece in found)
            joined = np.concatenate([piece.ravel() for piece in found])
            np.testing.assert_array_equal(joined, record.position[part].ravel())


def test_no_block_is_read_twice_for_a_whole_array(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "PIECE_BYTES", 100_000)
    grid = Grid((3, 301, 700), (1, 10, 700))
    whole = tuple(slice(0, n, 1) for n in grid.shape)
    touched = [index for piece in pieces(whole, grid, 8) for index in grid.touched(piece)]
    assert len(touched) == len(set(touched)) == 93
    assert sum(np.prod(lengths(piece)) for piece in pieces(whole, grid, 8)) == 3 * 301 * 700


def altered(archive: Archive, sealed: Sealed, name: str, place: Any) -> Sealed:
    """Change a value of an array, and return what is on record where sizes and bytes are not compared."""
    path = archive.store.path(sealed.path)
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        file[f"entry/{name}"][place] += 1
    return replace(sealed, size_bytes=path.stat().st_size, sha256="")


@pytest.mark.parametrize("index", list(np.ndindex(3, 2, 1)))
def test_an_altered_block_is_noticed_by_whoever_reads_of_it_and_no_other_is(
    archive: Archive, rng: np.random.Generator, index: tuple[int, int, int]
) -> None:
    record = large(rng)
    sealed = archive.seal_dataset({"surface": record}, provenance())
    grid = Grid((3, 301, 700), (1, 187, 700))
    component, rows, columns = grid.bounds(index)
    changed = altered(archive, sealed, "surface/position", (component.start, rows.stop - 1, 3))
    with archive.open(changed) as dataset, dataset.array("surface", "position") as stored:
        assert stored.grid == grid
        message = rf"surface\.position is not what was sealed: the block at {index[0]}, {rows.start}, 0 has"
        for part in ((component, rows, columns), (component, slice(rows.start, rows.start + 1, 1), columns)):
            with pytest.raises(ArchiveCorrupt, match=message):
                stored.read(part)
        for other in np.ndindex(3, 2, 1):
            if other != index:
                np.testing.assert_array_equal(stored.block(other), record.position[grid.bounds(other)])
        with pytest.raises(ArchiveCorrupt, match=message):
            stored.whole()


def test_two_blocks_that_have_changed_places_are_noticed(archive: Archive, rng: np.random.Generator) -> None:
    record = large(rng)
    sealed = archive.seal_dataset({"surface": record}, provenance())
    path = archive.store.path(sealed.path)
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        file["entry/surface/position"][[0, 2]] = record.position[[2, 0]]
    exchanged = replace(sealed, size_bytes=path.stat().st_size, sha256="")
    with archive.open(exchanged) as dataset:
        with pytest.raises(ArchiveCorrupt, match="the block at 0, 0, 0 has other values"):
            dataset.read("surface", Surface)
        with dataset.array("surface", "position") as stored:
            np.testing.assert_array_equal(stored.block((1, 0, 0)), record.position[1:2, :187])


@pytest.mark.parametrize(
    ("block", "checks"),
    [([1, 187], "00" * 24), ([1, 0, 700], "00" * 24), ([1, 187, 700], "00" * 20), ([1, 187, 700], "no")],
)
def test_checks_that_cannot_be_those_of_an_array_are_refused(block: list[int], checks: str) -> None:
    stated: ArrayDigest = {
        "name": "position",
        "dtype": "<f8",
        "shape": [3, 301, 700],
        "unit": "mm",
        "sha256": "",
        "block": block,
        "checks": checks,
    }
    with pytest.raises(ArchiveCorrupt, match=r"surface\.position cannot be read"):
        stored_array(np.zeros((3, 301, 700)), stated, "surface.position")


def test_an_array_that_rots_after_it_was_compared_is_noticed_where_it_did(
    archive: Archive, rng: np.random.Generator
) -> None:
    sealed = archive.seal_dataset({"surface": large(rng)}, provenance())
    first, last = ((slice(k, k + 1, 1), slice(300, 301, 1), slice(0, 9, 1)) for k in (0, 2))
    with archive.open(sealed) as dataset, dataset.array("surface", "position") as stored:
        stored.read(first)
    changed = altered(archive, sealed, "surface/position", (2, 300, 3))
    with archive.open(changed) as dataset, dataset.array("surface", "position") as stored:
        stored.read(first)
        with pytest.raises(ArchiveCorrupt, match="the block at 2, 187, 0 has other values"):
            stored.read(last)


def test_an_array_that_is_not_there_is_not_found(archive: Archive, sealed: Sealed) -> None:
    with archive.open(sealed) as dataset:
        with pytest.raises(NotFound, match="it has texture, frames"), dataset.array("measurement", "x"):
            pass
        with pytest.raises(NotFound, match="it has measurement"), dataset.array("strain", "x"):
            pass
