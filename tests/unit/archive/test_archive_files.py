"""A sealed file is whole or absent, tells when it was damaged, and opens in other people's viewers."""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import silx.io
from silx.io.nxdata import get_default
from support.sealing import (
    JOB,
    calibration,
    damaged,
    files_below,
    measurement,
    point_cloud,
    provenance,
    regions,
)

from sms_jobs.archive import Archive, Sealed
from sms_jobs.archive.repacking import repack
from sms_jobs.archive.sealing import SafeFile
from sms_jobs.errors import ArchiveCorrupt, Conflict, InvalidInput, NotFound, OtherFormat, StorageFull
from sms_jobs.records.fields import ImageMatches, Surface
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.subject import Subject

# --- sealing -----------------------------------------------------------------------------------------


def test_a_sealed_file_says_where_it_comes_from(archive: Archive, sealed: Sealed) -> None:
    assert sealed.path == "test/S00/C1P1/example-20260102T030405Z-01234567-1.h5"
    assert sealed.size_bytes == archive.store.path(sealed.path).stat().st_size
    archive.verify(sealed.path, sealed.content_hash)
    with archive.open(sealed) as dataset:
        assert dataset.provenance == provenance()
        assert dataset.subject == Subject("test", "S00", "C1P1")
        assert dataset.names == ("measurement",)
        assert dataset.content_hash == sealed.content_hash


def test_frames_are_read_from_the_open_file(archive: Archive, sealed: Sealed) -> None:
    expected = measurement(np.random.default_rng(7)).frames
    with archive.open(sealed) as dataset:
        frames = dataset.read("measurement", Measurement).frames
        assert frames.shape == expected.shape
        assert frames.dtype == expected.dtype
        np.testing.assert_array_equal(frames.frame(5), expected.frame(5))
        np.testing.assert_array_equal(frames.rows(60, 130), expected.rows(60, 130))
    with pytest.raises(ArchiveCorrupt):
        frames.frame(0)


def test_more_datasets_than_open_files_can_be_used_at_once(
    archive: Archive, rng: np.random.Generator
) -> None:
    sealed = archive.seal_dataset({"surface": point_cloud(rng)}, provenance())
    before = len(list(Path("/proc/self/fd").iterdir()))
    with ExitStack() as stack:
        datasets = [stack.enter_context(archive.open(sealed)) for _ in range(20)]
        assert [dataset.read("surface", Surface).camera for dataset in datasets] == ["C1"] * 20
        assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_what_is_asked_for_must_be_there(archive: Archive, sealed: Sealed) -> None:
    with archive.open(sealed) as dataset:
        with pytest.raises(NotFound, match="it has measurement"):
            dataset.read("strain", Surface)
        with pytest.raises(InvalidInput, match="is a Measurement, not a Surface"):
            dataset.read("measurement", Surface)


def test_a_file_describes_its_arrays_without_reading_them(archive: Archive, sealed: Sealed) -> None:
    with archive.open(sealed) as dataset:
        about = dataset.describe()
    assert about["measurement"]["frames"] == {
        "shape": [6, 150, 90],
        "dtype": "<u2",
        "unit": "count",
        "axes": ["frame", "row", "column"],
        "components": [],
        "meaning": "fringe frames",
    }
    assert list(about["measurement"]) == ["texture", "frames"]


def test_a_sealed_file_is_never_overwritten(archive: Archive, sealed: Sealed) -> None:
    before = archive.store.path(sealed.path).read_bytes()
    with pytest.raises(Conflict, match="never overwritten"):
        archive.seal_dataset({"regions": regions()}, provenance())
    assert archive.store.path(sealed.path).read_bytes() == before
    assert files_below(archive) == [sealed.path]


class FailingStack(ArrayStack):
    """Frames whose source fails half way."""

    def frame(self, index: int) -> Any:
        if index == 5:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().frame(index)


def test_a_full_disk_leaves_nothing_behind(archive: Archive, rng: np.random.Generator) -> None:
    whole = measurement(rng)
    broken = replace(whole, frames=FailingStack(whole.frames.rows(0, 150)))
    with pytest.raises(StorageFull, match="no room"):
        archive.seal_dataset({"measurement": broken}, provenance())
    assert files_below(archive) == []


def test_a_full_disk_is_no_damage_of_what_is_copied(
    archive: Archive, sealed: Sealed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(file: SafeFile, data: Any) -> int:
        file.error = OSError(errno.ENOSPC, "No space left on device")
        return len(data)

    monkeypatch.setattr(SafeFile, "write", write)
    with pytest.raises(StorageFull, match=f"the disk of {tmp_path} has no room for {sealed.path}; free"):
        repack(archive.store.path(sealed.path), tmp_path / "plain.h5", sealed.path)


WRITE_AND_STOP = """
import resource, sys
from datetime import UTC, datetime
from pathlib import Path
import os
import numpy as np
from sms_jobs.archive import Archive, FolderStore, Provenance
from sms_jobs.errors import FileTooLarge
from sms_jobs.records.subject import Subject
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement

class Stack(ArrayStack):
    def frame(self, index):
        if index == 20 and sys.argv[2] == "die":
            os._exit(9)
        return super().frame(index)

if sys.argv[2] == "limit":
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
frames = np.random.default_rng(0).integers(0, 4096, (24, 150, 90), dtype=np.uint16)
when = datetime(2026, 1, 2, tzinfo=UTC)
record = Measurement(when, FringeSequence(), 4095, 0.1, 2.0, frames[0], Stack(frames))
provenance = Provenance("example", 1, Subject("test"), "0123456789abcdef", 2,
                        when, {}, (), "0.1.0", "here", "me")
try:
    Archive(FolderStore(Path(sys.argv[1]))).seal_dataset({"measurement": record}, provenance)
except FileTooLarge as error:
    print(error, error.retryable)
"""


def write_and_stop(archive: Archive, how: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WRITE_AND_STOP, str(archive.store.root), how]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)


def test_a_killed_writer_leaves_only_a_temporary_file_that_its_job_finds(archive: Archive) -> None:
    assert write_and_stop(archive, "die").returncode == 9
    (left,) = files_below(archive)
    assert left.endswith(f"/.example-20260102T000000Z-01234567-2.h5.{JOB}.tmp")
    assert list(archive.files()) == []
    assert archive.leftovers(JOB) == (left,)
    archive.discard(left)
    assert files_below(archive) == []


def test_a_file_that_cannot_be_written_does_not_take_the_process_down(archive: Archive) -> None:
    # HDF5 crashes when it must give up a file that it can neither write nor close.
    done = write_and_stop(archive, "limit")
    assert done.returncode == 0, done.stderr
    assert f"the disk of {archive.store.root} takes no file as large as example-2026" in done.stdout
    assert done.stdout.endswith(" False\n")  # the same file is no smaller the next time
    assert files_below(archive) == []


class EndlessStack:
    """Frames that exist only while they are asked for."""

    shape = (48, 512, 512)
    dtype = np.dtype(np.uint16)

    def frame(self, index: int) -> Any:
        return np.full(self.shape[1:], index, np.uint16)

    def rows(self, start: int, stop: int) -> Any:
        raise AssertionError("frames are written one by one")


def test_frames_are_never_in_memory_as_a_whole(archive: Archive, rng: np.random.Generator) -> None:
    record = replace(measurement(rng), frames=EndlessStack())
    tracemalloc.start()
    archive.seal_dataset({"measurement": record}, provenance())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # The stack has 25.2 MB. In memory at a time: while writing 4 frames and one being made (2.6 MB); while
    # checking, a slab of at most 4 MiB and the one before it (8.4 MB); and some small change.
    assert peak < 10e6


# --- what the content hash covers ----------------------------------------------------------------------


def test_the_hash_depends_on_contents_alone(archive: Archive, rng: np.random.Generator) -> None:
    cloud = point_cloud(rng)
    first = archive.seal_dataset({"surface": cloud}, provenance())
    later = provenance(attempt=2, created_at=datetime(2027, 1, 1, tzinfo=UTC), host="there", operator="x")
    again = archive.seal_dataset(
        {"surface": replace(cloud, position=cloud.position[::1].copy(order="F"))}, later
    )
    assert first.content_hash == again.content_hash


@pytest.mark.parametrize("what", ["value", "text", "name", "order", "field"])
def test_the_hash_changes_with_everything_that_is_said(
    what: str, archive: Archive, rng: np.random.Generator
) -> None:
    cloud = point_cloud(rng)
    other = point_cloud(rng)
    records = {"surface": cloud, "regions": regions()}
    before = archive.seal_dataset(records, provenance())
    xyz = cloud.position.copy()
    xyz[2, -1, -1] = np.nextafter(xyz[2, -1, -1], np.inf)
    changed: dict[str, dict[str, Any]] = {
        "value": records | {"surface": replace(cloud, position=xyz)},
        "text": records | {"surface": replace(cloud, view="C2P1")},
        "name": {"points": cloud, "regions": regions()},
        "order": {"regions": regions(), "surface": cloud},
        "field": records | {"surface": replace(cloud, ray_gap=other.ray_gap)},
    }
    after = archive.seal_dataset(changed[what], provenance(attempt=2))
    assert before.content_hash != after.content_hash


def crc32_of_blocks(array: h5py.Dataset) -> Iterator[int]:
    """Yield the CRC-32 of each block, in C order."""
    block = array.attrs["block"]
    starts = [range(0, n, int(b)) for n, b in zip(array.shape, block, strict=True)]
    for start in itertools.product(*starts):
        part = tuple(slice(s, s + int(b)) for s, b in zip(start, block, strict=True))
        yield zlib.crc32(array[part].tobytes())


def test_the_hash_can_be_computed_from_the_description_of_the_format(
    archive: Archive, rng: np.random.Generator
) -> None:
    # Only h5py, hashlib, zlib and json: what docs/archive_format.md says, and nothing of the program.
    records = {
        "surface": point_cloud(rng),
        "calibration": calibration(),
        "regions": regions(),
        "measurement": measurement(rng),
    }
    sealed = archive.seal_dataset(records, provenance())
    manifest = []
    with h5py.File(archive.store.path(sealed.path)) as file:
        for name in file["entry"].attrs["records"]:
            group = file["entry"][name]
            arrays = [
                {
                    "name": array,
                    "dtype": group[array].dtype.str,
                    "shape": list(group[array].shape),
                    "unit": group[array].attrs["units"],
                    "sha256": hashlib.sha256(group[array][()].tobytes()).hexdigest(),
                    "block": group[array].attrs["block"].tolist(),
                    "checks": "".join(f"{crc:08x}" for crc in crc32_of_blocks(group[array])),
                }
                for array in group.attrs["arrays"]
            ]
            fields = group["record_fields"][()].decode()
            manifest.append(
                {"name": name, "record": group.attrs["record"], "fields": fields, "arrays": arrays}
            )
        assert file.attrs["content_hash"] == sealed.content_hash
    text = json.dumps(manifest, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert hashlib.sha256(text.encode()).hexdigest() == sealed.content_hash


# --- damage ----------------------------------------------------------------------------------------------


def test_a_truncated_file_is_found_out(archive: Archive, sealed: Sealed) -> None:
    damaged(archive, sealed, lambda data: data[: len(data) // 2])
    with pytest.raises(ArchiveCorrupt, match=r"example-.* cannot be read .*restore"):
        archive.verify(sealed.path, sealed.content_hash)
    with pytest.raises(ArchiveCorrupt), archive.open(sealed):
        pass


def test_a_flipped_bit_anywhere_in_the_frames_is_found_out(
    archive: Archive, sealed: Sealed, rng: np.random.Generator
) -> None:
    with h5py.File(archive.store.path(sealed.path)) as file:
        frames = file["entry/measurement/frames"].id
        chunk = frames.get_chunk_info(int(rng.integers(frames.get_num_chunks())))
    place = chunk.byte_offset + int(rng.integers(chunk.size))

    def flip(data: bytearray) -> bytearray:
        data[place] ^= 1 << int(rng.integers(8))
        return data

    damaged(archive, sealed, flip)
    with pytest.raises(ArchiveCorrupt):
        archive.verify(sealed.path, sealed.content_hash)
    # As one that is too large to have all of its bytes read before.
    with archive.open(replace(sealed, sha256="")) as dataset:
        stack = dataset.read("measurement", Measurement).frames
        with pytest.raises(ArchiveCorrupt):
            stack.rows(0, 150)


@pytest.mark.parametrize("where", ["provenance", "record_fields"])
def test_altered_text_is_found_out(where: str, archive: Archive, sealed: Sealed) -> None:
    old, new = {
        "provenance": (b'"threshold": 0.5, "names": ["a", "b"]}, "inputs"', b"0.5"),
        "record_fields": (b'"full_scale":4095', b"4095"),
    }[where]

    def alter(data: bytearray) -> bytearray:
        start = data.index(old)
        place = data.index(new, start)
        data[place + 2] = ord("7")
        return data

    damaged(archive, sealed, alter)
    with pytest.raises(ArchiveCorrupt):
        archive.verify(sealed.path, sealed.content_hash)


def test_another_hash_than_recorded_is_an_error(archive: Archive, sealed: Sealed) -> None:
    with pytest.raises(ArchiveCorrupt, match="is on record"):
        archive.verify(sealed.path, "0" * 64)


def test_a_missing_file_and_a_foreign_file_are_named(archive: Archive, sealed: Sealed) -> None:
    with (
        pytest.raises(ArchiveCorrupt, match=r"test/none-1\.h5 is missing"),
        archive.open_unrecorded("test/none-1.h5"),
    ):
        pass
    archive.store.path("test/foreign.h5").write_bytes(b"not HDF5 at all")
    with pytest.raises(ArchiveCorrupt, match="cannot be read"), archive.open_unrecorded("test/foreign.h5"):
        pass
    with h5py.File(archive.store.path("test/other.h5"), "w") as file:
        file["x"] = 1
    with (
        pytest.raises(ArchiveCorrupt, match="not one of this archive"),
        archive.open_unrecorded("test/other.h5"),
    ):
        pass


def test_a_file_of_a_newer_version_is_refused_with_both_versions(archive: Archive, sealed: Sealed) -> None:
    path = archive.store.path(sealed.path)
    path.chmod(0o644)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 7
    with (
        pytest.raises(OtherFormat, match=r"version 7, this program reads version 3"),
        archive.open_unrecorded(sealed.path),
    ):
        pass
    with pytest.raises(OtherFormat, match="version 7"):
        archive.verify(sealed.path, sealed.content_hash)


# --- NeXus -------------------------------------------------------------------------------------------------


def default_plot(path: Path) -> Any:
    with silx.io.open(str(path)) as file:
        plot = get_default(file)
        assert plot is not None
        assert plot.is_valid
        return plot.signal_name, plot.signal_dataset_name, plot.signal.shape, plot.axes_dataset_names


def test_viewers_open_a_measurement_with_its_texture(archive: Archive, sealed: Sealed) -> None:
    name, signal, shape, axes = default_plot(archive.store.path(sealed.path))
    assert (name, signal) == ("white-light texture [count]", "texture")
    assert shape == (150, 90)
    assert axes == ["row", "column"]


def test_viewers_open_a_result_with_its_first_image(archive: Archive, rng: np.random.Generator) -> None:
    result = archive.seal_dataset({"surface": point_cloud(rng), "regions": regions()}, provenance())
    _, signal, shape, axes = default_plot(archive.store.path(result.path))
    assert (signal, shape, axes) == ("position", (3, 40, 30), [None, "row", "column"])
    with h5py.File(archive.store.path(result.path)) as file:
        cloud = file["entry/surface"]
        assert cloud["reason"].attrs["flag_names"][0] == "LOW_MODULATION"
        assert list(cloud["position"].attrs["components"]) == ["X", "Y", "Z"]
        assert cloud["position"].attrs["units"] == "mm"
        assert all(cloud[name].fletcher32 for name in cloud.attrs["arrays"])


def test_viewers_pass_over_what_cannot_be_plotted(archive: Archive, rng: np.random.Generator) -> None:
    records = {"calibration": calibration(), "surface": point_cloud(rng)}
    result = archive.seal_dataset(records, provenance())
    assert default_plot(archive.store.path(result.path))[1] == "position"
    with archive.open(result) as dataset:
        assert dataset.names == ("calibration", "surface")


def test_viewers_open_points_as_a_scatter_plot(archive: Archive, rng: np.random.Generator) -> None:
    n = 50
    double, single = rng.normal(size=n), rng.normal(size=n).astype(np.float32)
    integer = np.ones(n, np.int32)
    matches = ImageMatches(
        x=double,
        y=double[::-1].copy(),
        region=integer,
        u=double,
        v=double,
        gradient=rng.normal(size=(4, n)),
        sigma_u=single,
        sigma_v=single,
        score=single,
        iterations=integer,
        reason=np.zeros(n, np.uint32),
    )
    result = archive.seal_dataset({"matches": matches}, provenance())
    with silx.io.open(str(archive.store.path(result.path))) as file:
        plot = get_default(file)
        assert plot.is_valid
        assert plot.is_scatter
        assert plot.signal_dataset_name == "u"
