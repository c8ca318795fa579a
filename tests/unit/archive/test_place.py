"""Which errors are the fault of a disk or share, and that a place is judged by using it."""

from __future__ import annotations

import errno
import resource
from pathlib import Path

import pytest

from sms_jobs.app.writing import new_file
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.archive.place import probe, require_usable, says_full, says_unusable, unusable
from sms_jobs.archive.sealing import sealing
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, StorageFull, StorageUnusable
from sms_jobs.records.subject import Subject

OF_THE_PLACE = [errno.EROFS, errno.EIO, errno.ESTALE, errno.EACCES, errno.EPERM, errno.ENOTCONN]


@pytest.mark.parametrize("number", OF_THE_PLACE)
def test_an_error_is_known_by_its_number_wherever_it_is_told(number: int) -> None:
    told_by_hdf5 = OSError(f"Unable to open file (errno = {number}, error message = 'so it is')")
    led_to_it = ArchiveCorrupt("cannot be read")
    led_to_it.__cause__ = told_by_hdf5
    for error in (OSError(number, "so it is"), told_by_hdf5, RuntimeError(str(told_by_hdf5)), led_to_it):
        assert says_unusable(error)
        assert not says_full(error)


@pytest.mark.parametrize("error", [OSError(errno.ENOENT, "no such file"), ValueError("errno = 5"), OSError()])
def test_what_may_be_the_fault_of_one_file_is_not_blamed_on_the_place(error: Exception) -> None:
    assert not says_unusable(error)


def test_a_full_disk_is_not_unusable() -> None:
    assert says_full(OSError(errno.ENOSPC, "full"))
    assert not says_unusable(OSError(errno.ENOSPC, "full"))


def test_a_disk_that_takes_no_file_so_large_says_so(tmp_path: Path) -> None:
    def grow(path: Path) -> None:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        try:
            path.write_bytes(bytes(2000))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    with (
        pytest.raises(InvalidInput, match=r"out.csv cannot be written: File too large; write elsewhere"),
        new_file(tmp_path / "out.csv", force=False) as part,
    ):
        grow(part)
    assert [one.name for one in tmp_path.rglob("*") if one.is_file()] == []


@pytest.mark.parametrize("number", OF_THE_PLACE)
def test_what_cannot_be_sealed_for_the_places_sake_may_be_tried_again(tmp_path: Path, number: int) -> None:
    def seal() -> None:
        with sealing(tmp_path, tmp_path / "plate" / "result.h5", "job") as temporary:
            temporary.write_bytes(b"half")
            raise OSError(number, "so it is")

    with pytest.raises(StorageUnusable, match="cannot be kept") as raised:
        seal()
    assert raised.value.retryable
    assert list((tmp_path / "plate").iterdir()) == []


def test_a_finding_names_folder_reason_and_next_step() -> None:
    for number in (*OF_THE_PLACE, errno.ENOENT):
        said = str(unusable(Path("/srv/archive"), OSError(number, "")))
        assert "/srv/archive (" in said
        assert ");" in said


def test_a_place_is_judged_by_using_it_and_left_as_it_was(tmp_path: Path) -> None:
    archive = Archive(FolderStore(tmp_path / "archive"))
    archive.probe(Subject("plate", "S00"))
    (archive.store.root / "plate").mkdir()
    archive.probe(Subject("plate", "S00"))
    assert [path.name for path in archive.store.root.rglob("*")] == ["plate"]
    require_usable(archive.store.root, 0.0)
    with pytest.raises(StorageFull, match="least_room_mb"):
        require_usable(archive.store.root, 1e12)
    for ask in (probe, lambda folder: require_usable(folder, 0.0)):
        with pytest.raises(StorageUnusable, match="mounted"):
            ask(tmp_path / "gone")
