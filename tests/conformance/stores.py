"""What every store promises: a subclass of `StoreTests` says how to make one, and inherits the tests."""

from __future__ import annotations

import errno
from abc import abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule, run_state_machine_as_test
from support.sealing import measurement, provenance

from sms_jobs.archive import Archive, Store, layout
from sms_jobs.errors import ArchiveCorrupt, Conflict, InvalidInput, StorageFull, StorageUnusable

NAME, OTHER = "plate/S00/C1P1/example-1.h5", "plate/S01/example-2.h5"
OUTSIDE = ["", "/etc/passwd", "..", "../x.h5", "a/../../x", "a\0b"]
NAMES = ["a.h5", "plate/a.h5", "plate/b.h5", "plate/S00/a.h5", ".aside/plate/a.h5"]
WRITER = "0123456789abcdef"


def put(store: Store, name: str, content: bytes, writer: str = WRITER) -> None:
    """Keep bytes under a name."""
    with store.create(name, writer) as file:
        file.write_bytes(content)


def content(store: Store, name: str) -> bytes:
    """Return all bytes that are under a name."""
    with store.open(name) as stream:
        return stream.read()


class StoreTests:
    """The promises of `Store`, one after the other."""

    @abstractmethod
    def made(self, folder: Path) -> Store:
        """Return an empty store; it may use a folder that is there for it."""

    @pytest.fixture
    def store(self, tmp_path: Path) -> Store:
        folder = tmp_path / "store"
        folder.mkdir()
        return self.made(folder)

    # --- writing ------------------------------------------------------------------------------------------

    @pytest.mark.parametrize("data", [b"", b"x", bytes(range(256)) * 4096], ids=["nothing", "one", "1 MiB"])
    def test_what_is_written_is_there_as_a_whole(self, store: Store, data: bytes) -> None:
        put(store, NAME, data)
        assert content(store, NAME) == data
        assert store.size(NAME) == len(data)
        assert store.exists(NAME)
        assert list(store.names()) == [NAME]

    def test_nothing_is_under_a_name_before_it_is_whole(self, store: Store) -> None:
        # As after the end of a writer that was killed here.
        with store.create(NAME, WRITER) as file:
            file.write_bytes(b"half")
            assert store.size(NAME) is None
            assert not store.exists(NAME)
            folder, _, last = NAME.rpartition("/")
            assert set(store.names()) <= {f"{folder}/{layout.temporary_name(last, WRITER)}"}
        assert list(store.names()) == [NAME]

    @pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
    def test_of_a_writer_that_fails_nothing_is_left(self, store: Store, error: type[BaseException]) -> None:
        def fail() -> None:
            with store.create(NAME, WRITER) as file:
                file.write_bytes(b"half")
                raise error("so it is")

        with pytest.raises(error):
            fail()
        assert list(store.names()) == []
        put(store, NAME, b"whole")
        assert content(store, NAME) == b"whole"

    def test_a_writer_that_writes_nothing_fails(self, store: Store) -> None:
        with pytest.raises(FileNotFoundError), store.create(NAME, WRITER):
            pass
        assert list(store.names()) == []

    @pytest.mark.parametrize(
        ("number", "raised"),
        [
            (errno.ENOSPC, StorageFull),
            (errno.EROFS, StorageUnusable),
            (errno.EIO, StorageUnusable),
            (errno.EFBIG, StorageUnusable),
        ],
    )
    def test_the_fault_of_the_place_is_called_so(
        self, store: Store, number: int, raised: type[Exception]
    ) -> None:
        def fail() -> None:
            with store.create(NAME, WRITER):
                raise OSError(number, "so it is")

        with pytest.raises(raised):
            fail()
        assert list(store.names()) == []

    def test_a_name_that_is_taken_is_a_conflict(self, store: Store) -> None:
        put(store, NAME, b"first")
        with pytest.raises(Conflict, match="never overwritten"):
            put(store, NAME, b"second")
        assert content(store, NAME) == b"first"
        assert list(store.names()) == [NAME]

    def test_a_name_that_is_taken_meanwhile_is_a_conflict(self, store: Store) -> None:
        def late() -> None:
            with store.create(NAME, "late") as file:
                file.write_bytes(b"late")
                put(store, NAME, b"first", "early")

        with pytest.raises(Conflict):
            late()
        assert content(store, NAME) == b"first"
        assert list(store.names()) == [NAME]

    def test_two_names_can_be_written_at_a_time(self, store: Store) -> None:
        with store.create(NAME, WRITER) as file:
            file.write_bytes(b"outer")
            put(store, OTHER, b"inner")
        assert sorted(store.names()) == [NAME, OTHER]

    def test_a_writer_has_a_name_that_a_file_can_have(self, store: Store) -> None:
        with pytest.raises(InvalidInput):
            put(store, NAME, b"", "../job")

    # --- replacing ----------------------------------------------------------------------------------------

    def test_a_file_is_replaced_by_a_copy(self, store: Store, tmp_path: Path) -> None:
        put(store, NAME, b"bad")
        good = tmp_path / "good"
        good.write_bytes(b"good")
        for name in (NAME, OTHER):
            seen: list[bytes] = []
            store.replace(name, good, lambda copy, seen=seen: seen.append(copy.read_bytes()))
            assert seen == [content(store, name)] == [b"good"]
        good.write_bytes(b"other")
        assert content(store, NAME) == b"good"

    def test_a_copy_that_is_refused_replaces_nothing(self, store: Store, tmp_path: Path) -> None:
        put(store, NAME, b"old")
        new = tmp_path / "new"
        new.write_bytes(b"new")

        def refuse(copy: Path) -> None:
            raise ArchiveCorrupt("it is another")

        for name in (NAME, OTHER):
            with pytest.raises(ArchiveCorrupt):
                store.replace(name, new, refuse)
        with pytest.raises(OSError):
            store.replace(NAME, tmp_path / "gone", lambda copy: None)
        assert content(store, NAME) == b"old"
        assert list(store.names()) == [NAME]

    # --- reading ------------------------------------------------------------------------------------------

    def test_any_range_can_be_read(self, store: Store) -> None:
        data = bytes(range(200))
        put(store, NAME, data)
        with store.open(NAME) as stream:
            for start, count in ((0, 10), (190, 10), (50, 3), (195, 100)):
                stream.seek(start)
                assert stream.read(count) == data[start : start + count]
            assert not stream.writable()

    def test_what_is_not_there_has_no_size(self, store: Store) -> None:
        put(store, NAME, b"x")
        for missing in (OTHER, "plate/S00", f"{NAME}.provenance.json"):
            assert store.size(missing) is None
        assert not store.exists(OTHER)
        with pytest.raises(FileNotFoundError):
            store.open(OTHER)

    def test_a_path_can_be_had(self, store: Store) -> None:
        put(store, NAME, b"content")
        with store.local(NAME) as file:
            assert file.read_bytes() == b"content"
            assert not file.stat().st_mode & 0o222
        with store.local(OTHER) as file:
            assert not file.exists()
        assert list(store.names()) == [NAME]

    # --- listing, moving, removing ------------------------------------------------------------------------

    def test_names_are_those_below_a_folder(self, store: Store) -> None:
        for name in (NAME, OTHER, "plateau/x.h5", ".set-aside/plate/x.h5", "plate/.logs/x", "x.h5"):
            put(store, name, b"")
        assert sorted(store.names()) == sorted([NAME, OTHER, "plateau/x.h5", "x.h5"])
        assert sorted(store.names("plate")) == [NAME, OTHER]
        assert list(store.names("plate/S00")) == [NAME]
        assert list(store.names("nowhere")) == []

    def test_a_file_is_moved(self, store: Store) -> None:
        put(store, NAME, b"content")
        store.move(NAME, f".set-aside/{NAME}")
        assert not store.exists(NAME)
        assert content(store, f".set-aside/{NAME}") == b"content"
        with pytest.raises(FileNotFoundError):
            store.move(NAME, OTHER)

    def test_nothing_is_moved_over_another(self, store: Store) -> None:
        put(store, NAME, b"one")
        put(store, OTHER, b"two")
        with pytest.raises(Conflict):
            store.move(NAME, OTHER)
        assert (content(store, NAME), content(store, OTHER)) == (b"one", b"two")

    def test_what_is_removed_is_gone_and_may_be_removed_again(self, store: Store) -> None:
        put(store, NAME, b"x")
        put(store, f"{NAME}.provenance.json", b"y")
        put(store, OTHER, b"z")
        for _ in range(2):
            store.delete(NAME, f"{NAME}.provenance.json")
        store.delete("nowhere/x.h5")
        assert list(store.names()) == [OTHER]
        put(store, NAME, b"again")

    @pytest.mark.parametrize("name", OUTSIDE)
    def test_no_name_leads_out(self, store: Store, tmp_path: Path, name: str) -> None:
        put(store, NAME, b"x")
        (tmp_path / "file").write_bytes(b"")
        asked: list[Any] = [
            lambda: put(store, name, b""),
            lambda: store.replace(name, tmp_path / "file", lambda copy: None),
            lambda: store.size(name),
            lambda: store.exists(name),
            lambda: store.open(name),
            lambda: store.local(name).__enter__(),
            lambda: store.move(name, OTHER),
            lambda: store.move(NAME, name),
            lambda: store.delete(name),
            lambda: store.location(name),
        ]
        if name:
            asked.append(lambda: list(store.names(name)))
        for ask in asked:
            with pytest.raises(InvalidInput, match="not a path inside"):
                ask()
        assert list(store.names()) == [NAME]

    # --- the place ----------------------------------------------------------------------------------------

    def test_a_place_is_judged_and_left_as_it_was(self, store: Store) -> None:
        put(store, NAME, b"x")
        store.probe()
        store.probe("plate/S00")
        store.probe("plate/S07/C1P1")
        store.require_usable(0.0)
        assert list(store.names()) == [NAME]
        assert 0 < store.room().free_bytes <= store.room().whole_bytes

    def test_it_can_be_named_and_its_files_found(self, store: Store) -> None:
        assert store.where
        assert NAME in store.location(NAME)

    def test_a_file_is_linked_in_and_out_where_that_is_possible(self, store: Store, tmp_path: Path) -> None:
        if not store.capabilities.hard_links:
            pytest.skip("has no hard links")
        original = tmp_path / "original"
        original.write_bytes(b"content")
        with store.create(NAME, WRITER) as file:
            file.hardlink_to(original)
        with store.local(NAME) as file:
            (tmp_path / "out").hardlink_to(file)
        assert original.stat().st_nlink == 3

    # --- on top of it -------------------------------------------------------------------------------------

    def test_an_archive_seals_reads_verifies_and_sets_aside(self, store: Store) -> None:
        archive = Archive(store)
        record = measurement(np.random.default_rng(7))
        sealed = archive.seal_dataset({"measurement": record}, provenance())
        page = archive.seal_document(
            "page.html", "text/html", lambda path: path.write_text("x"), provenance()
        )
        for file in (sealed, page):
            archive.verify(file.path, file.content_hash)
            archive.verify_bytes(file)
        archive.verify_provenance(page.path, page.content_hash)
        with archive.open(sealed) as dataset:
            frames = dataset.read("measurement", type(record)).frames
            np.testing.assert_array_equal(frames.rows(0, 150), record.frames.rows(0, 150))
        assert sorted(archive.files()) == sorted([sealed.path, page.path])
        assert dict(archive.strays()) == {}
        assert archive.set_aside(page.path) == f".set-aside/{page.path}"
        assert list(archive.files()) == [sealed.path]
        with pytest.raises(ArchiveCorrupt, match="missing"):
            archive.verify_bytes(page)

    def test_an_archive_takes_files_from_another(self, store: Store, tmp_path: Path) -> None:
        other = Archive(self.made(tmp_path))
        sealed = other.seal_dataset({"measurement": measurement(np.random.default_rng(7))}, provenance())
        archive = Archive(store)
        archive.adopt(sealed.path, other)
        archive.adopt(sealed.path, other)
        archive.verify(sealed.path, sealed.content_hash)
        archive.discard(sealed.path)
        archive.bring(sealed, other)
        archive.verify_bytes(sealed)
        if not store.capabilities.hard_links:
            archive.discard(sealed.path)
            with pytest.raises(InvalidInput, match="hard links"):
                archive.adopt(sealed.path, other, link=True)

    def test_it_does_what_a_dictionary_does(self, tmp_path: Path) -> None:
        made, folders = self.made, iter(range(1_000_000))

        class Against(StoreMachine):
            def store_of_its_own(self) -> Store:
                folder = tmp_path / str(next(folders))
                folder.mkdir()
                return made(folder)

        run_state_machine_as_test(  # type: ignore[no-untyped-call]
            Against,
            settings=settings(
                max_examples=30, stateful_step_count=30, suppress_health_check=[HealthCheck.too_slow]
            ),
        )


names, contents = st.sampled_from(NAMES), st.binary(max_size=9)


class StoreMachine(RuleBasedStateMachine):
    """Drives a store at random against a dictionary."""

    def __init__(self) -> None:
        super().__init__()
        self.store = self.store_of_its_own()
        self.model: dict[str, bytes] = {}

    @abstractmethod
    def store_of_its_own(self) -> Store:
        """Return an empty store."""

    @rule(name=names, data=contents)
    def create(self, name: str, data: bytes) -> None:
        try:
            put(self.store, name, data)
        except Conflict:
            assert name in self.model
        else:
            assert name not in self.model
            self.model[name] = data

    @rule(name=names)
    def fail(self, name: str) -> None:
        why = Conflict if name in self.model else FileNotFoundError
        with pytest.raises(why), self.store.create(name, WRITER) as file:
            (file.write_bytes(b"half"), file.unlink())

    @rule(name=names, other=names)
    def move(self, name: str, other: str) -> None:
        try:
            self.store.move(name, other)
        except Conflict:
            assert other in self.model
        except FileNotFoundError:
            assert name not in self.model
        else:
            self.model[other] = self.model.pop(name)

    @rule(name=names, other=names)
    def replace(self, name: str, other: str) -> None:
        if other in self.model:
            with self.store.local(other) as file:
                self.store.replace(name, file, lambda copy: None)
            self.model[name] = self.model[other]

    @rule(name=names)
    def delete(self, name: str) -> None:
        self.store.delete(name)
        self.model.pop(name, None)

    @rule(name=names, start=st.integers(0, 9), count=st.integers(0, 9))
    def read(self, name: str, start: int, count: int) -> None:
        if name in self.model:
            with self.store.open(name) as stream:
                stream.seek(start)
                assert stream.read(count) == self.model[name][start : start + count]

    @invariant()
    def it_is_the_dictionary(self) -> None:
        shown = {name for name in self.model if not name.startswith(".")}
        assert sorted(self.store.names()) == sorted(shown)
        for folder in ("plate", "plate/S00", "nowhere"):
            assert set(self.store.names(folder)) == {n for n in shown if n.startswith(f"{folder}/")}
        for name in NAMES:
            assert self.store.exists(name) == (name in self.model)
            assert self.store.size(name) == (len(self.model[name]) if name in self.model else None)
