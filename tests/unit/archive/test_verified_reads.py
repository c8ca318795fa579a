"""What is read is what was sealed: files, texts, arrays and blocks of frames that are others are noticed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import h5py
import numpy as np
import pytest
from support.sealing import calibration, damaged, measurement, point_cloud, provenance

from sms_jobs.archive import Archive, Sealed
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.sensors import Calibration

SEEN = r"is not what was sealed.*sms archive repair"


def changed(archive: Archive, sealed: Sealed, change: Callable[[h5py.File], object]) -> None:
    """Change a sealed file as a program does that leaves everything else of it right."""
    path = archive.store.path(sealed.path)
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        change(file)


def put(array: Any, place: Any, value: Any) -> None:
    array[place] = value


def test_one_digit_of_a_calibration_is_noticed(archive: Archive) -> None:
    sealed = archive.seal_dataset({"calibration": calibration()}, provenance())
    damaged(archive, sealed, lambda data: data.replace(b'"fx":100.0', b'"fx":900.0'))
    with pytest.raises(ArchiveCorrupt, match=SEEN), archive.open(sealed):
        pass
    # Where the bytes are not on record, the contents are.
    for opened in (archive.open(replace(sealed, sha256="")), archive.open_unrecorded(sealed.path)):
        with opened as dataset, pytest.raises(ArchiveCorrupt, match=SEEN):
            dataset.read("calibration", Calibration)


def test_files_that_were_exchanged_are_noticed(archive: Archive, rng: np.random.Generator) -> None:
    one, other = (
        archive.seal_dataset({"measurement": measurement(rng)}, provenance(attempt=k)) for k in (1, 2)
    )
    paths = [archive.store.path(sealed.path) for sealed in (one, other)]
    aside = paths[0].with_name("aside")
    shutil.move(paths[0], aside)
    shutil.move(paths[1], paths[0])
    shutil.move(aside, paths[1])
    for sealed in (one, other):
        with pytest.raises(ArchiveCorrupt, match=SEEN), archive.open(sealed):
            pass
        # Even where the sizes are alike.
        alike = replace(sealed, size_bytes=archive.store.path(sealed.path).stat().st_size, sha256="")
        with pytest.raises(ArchiveCorrupt, match=sealed.content_hash[:12]), archive.open(alike):
            pass


def test_an_array_with_other_values_is_noticed_when_it_is_read(
    archive: Archive, rng: np.random.Generator
) -> None:
    sealed = archive.seal_dataset({"surface": point_cloud(rng)}, provenance())
    changed(archive, sealed, lambda file: put(file["entry/surface/ray_gap"], (3, 4), 7.0))
    size = archive.store.path(sealed.path).stat().st_size
    with (
        archive.open(replace(sealed, size_bytes=size, sha256="")) as dataset,
        pytest.raises(ArchiveCorrupt, match=r"surface\.ray_gap is not what was sealed"),
    ):
        dataset.read("surface", Surface)


@pytest.mark.parametrize(("frame", "row"), [(0, 0), (2, 63), (3, 64), (5, 149)])
def test_a_block_of_frames_with_other_values_is_noticed(
    archive: Archive, sealed: Sealed, frame: int, row: int
) -> None:
    changed(archive, sealed, lambda file: put(file["entry/measurement/frames"], (frame, row, 5), 5000))
    size = archive.store.path(sealed.path).stat().st_size
    with archive.open(replace(sealed, size_bytes=size, sha256="")) as dataset:
        frames = dataset.read("measurement", Measurement).frames
        first, top = frame // 4 * 4, row // 64 * 64
        where = rf"the block at {first}, {top}, 0 has other values"
        for start, stop in ((top, min(top + 64, 150)), (row, row + 1), (0, 150), (max(row - 7, 0), row + 1)):
            with pytest.raises(ArchiveCorrupt, match=where):
                frames.rows(start, stop)
        with pytest.raises(ArchiveCorrupt, match=where):
            frames.frame(frame)
        other = 0 if first else 5
        assert frames.frame(other).shape == (150, 90)


def test_slabs_are_the_same_however_they_lie_in_blocks(archive: Archive, rng: np.random.Generator) -> None:
    record = measurement(rng)
    sealed = archive.seal_dataset({"measurement": record}, provenance())
    wanted = record.frames.rows(0, 150)
    with archive.open(sealed) as dataset:
        frames = dataset.read("measurement", Measurement).frames
        for start, stop in ((0, 64), (64, 128), (128, 150), (0, 150), (3, 5), (60, 70), (149, 150), (7, 7)):
            np.testing.assert_array_equal(frames.rows(start, stop), wanted[:, start:stop])
        for index in (0, 3, 4, 5, -1):
            np.testing.assert_array_equal(frames.frame(index), wanted[index])
        with pytest.raises(IndexError):
            frames.frame(6)


@pytest.mark.parametrize("attribute", ["block", "sha256", "units"])
def test_what_stands_beside_an_array_is_verified_too(
    archive: Archive, sealed: Sealed, attribute: str
) -> None:
    def change(file: h5py.File) -> None:
        attributes = file["entry/measurement/frames"].attrs
        value = attributes[attribute]
        attributes.modify(attribute, value + 1 if isinstance(value, np.ndarray) else f"{value[:-1]}~")

    changed(archive, sealed, change)
    with pytest.raises(ArchiveCorrupt):
        archive.verify(sealed.path, sealed.content_hash)
    size = archive.store.path(sealed.path).stat().st_size
    with archive.open(replace(sealed, size_bytes=size, sha256="")) as dataset:
        # For people and other programs: jobs read what the manifest says.
        dataset.read("measurement", Measurement).frames.frame(0)


def test_a_manifest_that_is_another_is_noticed_at_once(archive: Archive, sealed: Sealed) -> None:
    damaged(archive, sealed, lambda data: data.replace(b'\\"gain\\":0.1', b'\\"gain\\":0.2'))
    with pytest.raises(ArchiveCorrupt, match=SEEN), archive.open(replace(sealed, sha256="")):
        pass


def test_a_file_that_changes_while_it_is_read_is_noticed(archive: Archive) -> None:
    sealed = archive.seal_dataset({"calibration": calibration()}, provenance())
    with archive.open(sealed) as dataset:
        dataset.read("calibration", Calibration)
        damaged(archive, sealed, lambda data: data.replace(b'"fx":100.0', b'"fx":900.0'))
        with pytest.raises(ArchiveCorrupt, match=SEEN):
            dataset.read("calibration", Calibration)


def test_a_stack_may_have_more_blocks_than_an_attribute_usually_holds(
    archive: Archive, rng: np.random.Generator
) -> None:
    # 17,000 frames of a few pixels: 4,250 groups of frames, 5 bands of rows, 85 kB of checks.
    record = replace(measurement(rng, 300, 1), frames=Stripes())
    sealed = archive.seal_dataset({"measurement": record}, provenance())
    with archive.open(sealed) as dataset:
        frames = dataset.read("measurement", Measurement).frames
        assert int(frames.frame(16_999)[299, 0]) == 16_999 % 251


class Stripes:
    """Many frames that are made when they are asked for."""

    shape = (17_000, 300, 1)
    dtype = np.dtype(np.uint8)

    def frame(self, index: int) -> np.ndarray:
        return np.full(self.shape[1:], index % 251, np.uint8)
