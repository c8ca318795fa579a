"""Names that stay inside the archive, and the places of documents and calibrations."""

from __future__ import annotations

import errno
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from support.sealing import JOB, calibration, damaged, files_below, provenance, regions

from sms_jobs.archive import Archive, Provenance
from sms_jobs.errors import ArchiveCorrupt, InvalidInput, StorageFull
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject

# --- names -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["../x.h5", "/etc/passwd", "a/../../x", "", "a\0b", ".."])
def test_paths_stay_inside_the_archive(path: str, archive: Archive) -> None:
    with pytest.raises(InvalidInput, match="not a path inside"):
        archive.store.path(path)
    with pytest.raises(InvalidInput):
        archive.discard(path)


def test_links_do_not_lead_out_of_the_archive(archive: Archive, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "secret.h5").write_bytes(b"x")
    (archive.store.root / "test").symlink_to(outside)
    with pytest.raises(InvalidInput, match="through a link"):
        archive.store.path("test/secret.h5")
    with pytest.raises(InvalidInput, match="through a link"):
        archive.discard("test/secret.h5")
    with pytest.raises(InvalidInput, match="through a link"):
        archive.seal_dataset({"regions": regions()}, provenance())
    assert [p.name for p in outside.iterdir()] == ["secret.h5"]


@pytest.mark.parametrize(
    "changes",
    [
        {"subject": Subject("..")},
        {"subject": Subject("test", "../../S00")},
        {"subject": Subject("test", "S00", "C1/P1")},
        {"kind": "../example"},
        {"job_id": "../../etc"},
        {"created_at": datetime(2026, 1, 1)},  # noqa: DTZ001
    ],
)
def test_names_that_could_lead_elsewhere_are_refused(changes: Any, archive: Archive) -> None:
    with pytest.raises(InvalidInput):
        archive.seal_dataset({"regions": regions()}, provenance(**changes))
    assert files_below(archive) == []


@pytest.mark.parametrize("name", ["../x.html", "a/b.html", ".hidden", "x.provenance.json", ""])
def test_names_of_documents_are_plain(name: str, archive: Archive) -> None:
    with pytest.raises(InvalidInput, match="name of a document"):
        archive.seal_document(name, "text/html", lambda p: None, provenance())


def test_a_job_finds_its_own_files_and_no_others(archive: Archive) -> None:
    mine = archive.seal_dataset({"regions": regions()}, provenance())
    mine_too = archive.seal_dataset({"regions": regions()}, provenance(attempt=2, subject=Subject("test")))
    page = archive.seal_document("p.html", "text/html", lambda p: None or p.write_text("x"), provenance())
    begins_alike = provenance(job_id=JOB[:8] + "ffffffff", attempt=3)
    other = archive.seal_dataset({"regions": regions()}, begins_alike)
    found = archive.leftovers(JOB)
    assert set(found) == {mine.path, mine_too.path, page.path}
    assert set(archive.files()) == {mine.path, mine_too.path, page.path, other.path}
    assert set(archive.leftovers(JOB, Subject("test", "S00"))) == {mine.path, page.path}
    assert archive.leftovers(JOB, Subject("elsewhere")) == ()
    for path in found:
        archive.discard(path)
    archive.discard(mine.path)  # twice does no harm
    assert files_below(archive) == [other.path]


def test_the_provenance_of_a_document_that_was_never_sealed_is_found(archive: Archive) -> None:
    page = archive.seal_document("p.html", "text/html", lambda p: None or p.write_text("x"), provenance())
    archive.store.path(page.path).unlink()
    assert archive.leftovers(JOB) == (f"{page.path}.provenance.json",)
    archive.discard(f"{page.path}.provenance.json")
    assert files_below(archive) == []


# --- documents and calibrations ----------------------------------------------------------------------------


def test_documents_are_sealed_with_their_provenance(archive: Archive) -> None:
    def write(path: Path) -> None:
        path.write_bytes(b"<p>")

    sealed = archive.seal_document("report.html", "text/html", write, provenance())
    assert sealed.path == "test/S00/C1P1/example-20260102T030405Z-01234567-1-report.html"
    assert (sealed.size_bytes, sealed.media_type) == (3, "text/html")
    archive.verify(sealed.path, sealed.content_hash)
    assert archive.document_provenance(sealed.path) == provenance()
    beside = json.loads(archive.store.path(f"{sealed.path}.provenance.json").read_text())
    assert (beside["filename"], beside["content_hash"]) == ("report.html", sealed.content_hash)
    damaged(archive, sealed, lambda data: data + b"!")
    with pytest.raises(ArchiveCorrupt, match="is on record"):
        archive.verify(sealed.path, sealed.content_hash)


def test_a_document_that_fails_leaves_nothing_behind(archive: Archive) -> None:
    with pytest.raises(InvalidInput, match="nothing was written"):
        archive.seal_document("a.html", "text/html", lambda path: None, provenance())

    def fill_up(path: Path) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(StorageFull):
        archive.seal_document("b.html", "text/html", fill_up, provenance())
    assert files_below(archive) == []


def of_a_rig(at: datetime) -> Provenance:
    """Return where a calibration is from that a person brought in."""
    return provenance(
        kind="calibration", subject=Subject("calibrations", "rig"), job_id="", inputs=(), created_at=at
    )


def test_calibrations_have_a_place_of_their_own(archive: Archive) -> None:
    when = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    sealed = archive.seal_dataset({"calibration": calibration()}, of_a_rig(when))
    assert sealed.path == "calibrations/rig/calibration-20260102T030405Z-nojob-1.h5"
    archive.verify(sealed.path, sealed.content_hash)
    with archive.open(sealed) as dataset:
        assert dataset.read("calibration", Calibration) == calibration()


def test_two_calibrations_of_a_rig_may_come_in_the_same_second(archive: Archive) -> None:
    now = datetime(2026, 1, 1, tzinfo=UTC)
    sealed = [
        archive.seal_dataset({"calibration": calibration()}, archive.with_free_name(of_a_rig(now)))
        for _ in range(3)
    ]
    assert len({file.path for file in sealed}) == 3
    assert len({file.content_hash for file in sealed}) == 1
