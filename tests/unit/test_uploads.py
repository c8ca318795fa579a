"""Files that come in chunks."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.importing import uploads
from sms_jobs.app.importing.uploads import Chunk
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput, NotFound


@pytest.fixture
def services(home: Path) -> Iterator[Services]:
    """Services of an empty home."""
    initialised(home)
    with bootstrap.services(home) as opened:
        yield opened


def chunk(content: bytes, offset: int = 0) -> Chunk:
    """Return a chunk with the hash of its bytes."""
    return Chunk(offset, memoryview(content), hashlib.sha256(content).hexdigest())


def test_an_upload_that_broke_off_goes_on_where_it_was(services: Services) -> None:
    upload = uploads.begin(services).id
    uploads.write(services, upload, "a/left.tif", chunk(b"one"))
    (there,) = uploads.show(services, upload).files
    assert (there.name, there.size_bytes) == ("a/left.tif", 3)
    uploads.write(services, upload, "a/left.tif", chunk(b"two", there.size_bytes))
    with uploads.opened(services, upload) as folder:
        assert (folder / "a" / "left.tif").read_bytes() == b"onetwo"
    assert uploads.show(services, upload).size_bytes == 6


def test_a_chunk_that_comes_twice_is_there_once(services: Services) -> None:
    upload = uploads.begin(services).id
    for _ in range(2):
        done = uploads.write(services, upload, "x", chunk(b"one"))
    assert done.size_bytes == uploads.show(services, upload).size_bytes == 3
    with pytest.raises(Conflict, match="go on at offset 3, not 0"):
        uploads.write(services, upload, "x", chunk(b"two"))


def test_a_damaged_chunk_is_not_added(services: Services) -> None:
    upload = uploads.begin(services).id
    with pytest.raises(InvalidInput, match="not those of the hash"):
        uploads.write(services, upload, "x", replace(chunk(b"one"), sha256="0" * 64))
    assert uploads.show(services, upload).files == ()


def test_a_name_cannot_leave_its_folder(services: Services) -> None:
    upload = uploads.begin(services).id
    before = sorted(services.settings.home.rglob("*"))
    climbing = ("", "/etc/x", "../x", "a/../x", "a//x", "./x")
    strange = (".x", "a/.x", "a\\x", "x\0", "x\n", "x\udcff", "x" * 201, "a/" * 9 + "x")
    for name in climbing + strange:
        with pytest.raises(InvalidInput):
            uploads.write(services, upload, name, chunk(b"one"))
    assert sorted(services.settings.home.rglob("*")) == before


def test_a_file_is_no_folder(services: Services) -> None:
    upload = uploads.begin(services).id
    uploads.write(services, upload, "a/x", chunk(b"one"))
    for name in ("a", "a/x/y"):
        with pytest.raises(InvalidInput, match="of this upload"):
            uploads.write(services, upload, name, chunk(b"one"))


def test_an_upload_is_of_who_began_it(services: Services) -> None:
    upload = uploads.begin(services).id
    other = services.acting(replace(services.actor, name="ben"))
    assert uploads.list_uploads(other) == []
    for name in (upload, "../" + upload, "nothing"):
        with pytest.raises(NotFound, match="ben has no upload"):
            uploads.show(other, name)
    with pytest.raises(NotFound):
        uploads.write(other, upload, "x", chunk(b"one"))


def test_an_upload_ends_after_a_day_unless_it_is_used(services: Services) -> None:
    kept, ended = (uploads.begin(services).id for _ in range(2))
    folder = services.settings.spool_folder / "uploads"
    for upload in (kept, ended):
        about = folder / upload / "about.json"
        long_ago = datetime.now(UTC) - timedelta(days=1, seconds=1)
        about.write_text(json.dumps(json.loads(about.read_text()) | {"started_at": long_ago.isoformat()}))
    with pytest.raises(NotFound, match="has ended"):
        uploads.show(services, ended)
    with uploads._opened(folder / kept):
        fresh = uploads.begin(services).id
    assert sorted(path.name for path in folder.iterdir()) == sorted([kept, fresh])


def test_uploads_are_bounded(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    upload = uploads.begin(services).id
    with pytest.raises(InvalidInput, match="at most"):
        uploads.write(services, upload, "x", chunk(bytes(uploads.CHUNK_BYTES + 1)))
    monkeypatch.setattr(uploads, "MOST_BYTES", 5)
    monkeypatch.setattr(uploads, "MOST_FILES", 1)
    uploads.write(services, upload, "x", chunk(b"four"))
    for name, sent in (("x", chunk(b"ab", 4)), ("y", chunk(b""))):
        with pytest.raises(InvalidInput, match="begin another"):
            uploads.write(services, upload, name, sent)
    for _ in range(uploads.MOST_AT_A_TIME - 1):
        uploads.begin(services)
    with pytest.raises(Conflict, match="remove one"):
        uploads.begin(services)


def test_nothing_is_removed_while_it_is_imported(services: Services) -> None:
    upload = uploads.begin(services).id
    with uploads.opened(services, upload), pytest.raises(Conflict, match="try again"):
        uploads.remove(services, upload)
    uploads.remove(services, upload)
    assert uploads.list_uploads(services) == []
