"""Every store keeps the promises of `Store`; what is said of a folder alone is tried here too."""

from __future__ import annotations

from pathlib import Path

import pytest
from conformance.stores import NAME, WRITER, StoreTests, content, put

from sms_jobs.archive import FolderStore, MemoryStore, Store
from sms_jobs.errors import ConfigurationError, InvalidInput


class TestFolderStore(StoreTests):
    def made(self, folder: Path) -> Store:
        return FolderStore(folder)

    def test_links_are_followed_inside_and_refused_outside(self, tmp_path: Path) -> None:
        store = FolderStore(tmp_path / "store")
        put(store, NAME, b"content")
        (store.root / "alias").symlink_to("plate")
        (store.root / "out").symlink_to(tmp_path)
        (store.root / "leads-out.h5").symlink_to("/etc/hostname")
        (tmp_path / "x.h5").write_bytes(b"secret")
        assert content(store, NAME.replace("plate", "alias")) == b"content"
        for name in ("out/x.h5", "leads-out.h5"):
            for ask in (store.size, store.open, store.location, store.local):
                with pytest.raises(InvalidInput, match="through a link"):
                    ask(name)
        with pytest.raises(InvalidInput, match="through a link"):
            put(store, "out/new.h5", b"")
        # What cannot be read can be moved out of the way and removed; what it points to stays.
        assert store.exists("leads-out.h5")
        store.move("leads-out.h5", ".set-aside/leads-out.h5")
        store.delete(".set-aside/leads-out.h5")
        assert not store.exists(".set-aside/leads-out.h5")
        assert Path("/etc/hostname").exists()

    def test_names_do_not_come_from_folders_that_are_links(self, tmp_path: Path) -> None:
        store = FolderStore(tmp_path / "store")
        put(store, NAME, b"")
        (store.root / "alias").symlink_to("plate")
        assert list(store.names()) == [NAME]

    def test_what_is_sealed_is_read_only_and_may_be_linked(self, tmp_path: Path) -> None:
        store = FolderStore(tmp_path)
        with store.create(NAME, WRITER) as file:
            file.write_bytes(b"x")
            assert file.parent == store.path(NAME).parent
        assert store.path(NAME).stat().st_mode & 0o777 == 0o444
        assert store.location(NAME) == str(tmp_path / NAME)

    def test_where_no_folder_can_be_is_no_store(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_bytes(b"")
        with pytest.raises(ConfigurationError, match="setting 'archive'"):
            FolderStore(tmp_path / "file" / "archive")


class TestMemoryStore(StoreTests):
    def made(self, folder: Path) -> Store:
        return MemoryStore()
