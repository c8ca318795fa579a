"""Messages as files: each is read once and whole, and what cannot be read stops nobody."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path
from queue import Empty

import pytest
from kombu import Connection
from kombu.exceptions import ChannelError

from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import make_app
from sms_jobs.workers.file_transport import Transport

QUEUE = "sms.cpu"


@pytest.fixture
def messages(tmp_path: Path) -> Path:
    """The folder of the messages of a home."""
    return Settings(home=tmp_path).message_folder / "queue"


@pytest.fixture(autouse=True)
def a_process_of_its_own() -> None:
    # Kombu keeps who listens to what for the whole process, whatever folder that was in.
    Transport.global_state.clear()


def connected(tmp_path: Path) -> Connection:
    return make_app(Settings(home=tmp_path)).connection_for_write()


def all_of(connection: Connection) -> list[object]:
    """Return what there is, in the order in which it comes."""
    found: list[object] = []
    with connection.SimpleQueue(QUEUE, no_ack=True) as queue:
        while True:
            try:
                found.append(queue.get(timeout=0.2).payload)
            except Empty:
                return found


def test_what_cannot_be_read_is_dropped_and_the_rest_is_read(tmp_path: Path, messages: Path) -> None:
    with connected(tmp_path) as connection:
        with connection.SimpleQueue(QUEUE) as queue:
            for number in range(3):
                queue.put(number)
        # Names begin with the time: these two come before and after all others.
        (messages / f"0_empty.{QUEUE}.msg").touch()
        (messages / f"9_cut-off.{QUEUE}.msg").write_text('{"body": "')
        assert sorted(all_of(connection)) == [0, 1, 2]
        assert list(messages.iterdir()) == []


def test_a_message_that_cannot_be_written_leaves_nothing(tmp_path: Path, messages: Path) -> None:
    with connected(tmp_path) as connection, connection.SimpleQueue(QUEUE) as queue:
        shutil.rmtree(messages)
        with pytest.raises(ChannelError, match="cannot be written"):
            queue.put(1)
        messages.mkdir()
        queue.put(2)
        assert len(list(messages.iterdir())) == 1
        assert all_of(connection) == [2]


@pytest.mark.parametrize("torn", ["", '[["sms.c'])
def test_a_torn_table_of_listeners_is_made_again(tmp_path: Path, messages: Path, torn: str) -> None:
    with connected(tmp_path) as connection, connection.SimpleQueue(QUEUE) as queue:
        queue.put(1)
    (table,) = (p for p in (messages.parent / "control").iterdir() if p.name.startswith(QUEUE))
    table.write_text(torn)
    Transport.global_state.clear()  # as in another process
    with connected(tmp_path) as connection:
        assert connection.default_channel.get_table(QUEUE) == []
        with connection.SimpleQueue(QUEUE) as queue:
            queue.put(2)
        assert all_of(connection) == [1, 2]


def test_readers_and_writers_at_once_have_each_message_once(tmp_path: Path) -> None:
    number, writers = 60, 2
    found: list[object] = []

    def write(first: int) -> None:
        with connected(tmp_path) as connection, connection.SimpleQueue(QUEUE) as queue:
            for k in range(number):
                queue.put(first + k)

    def read() -> None:
        with connected(tmp_path) as connection:
            found.extend(all_of(connection))

    # Of the threads of a process, Kombu lets only the first say who listens, and the others go on at once.
    with connected(tmp_path) as connection, connection.SimpleQueue(QUEUE):
        pass
    writing = [threading.Thread(target=write, args=(number * k,)) for k in range(writers)]
    reading = [threading.Thread(target=read) for _ in range(2)]
    for thread in (*writing, *reading):
        thread.start()
    for thread in (*writing, *reading):
        thread.join()
    read()  # what was written after the readers had gone
    assert sorted(found) == list(range(writers * number))
