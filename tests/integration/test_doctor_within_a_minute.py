"""What `sms doctor` knows, it knows within a minute: each finding, asked for 60 s after its cause began.

The clock of a database and a Redis server are compared when they are asked, see `test_doctor.py`.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import types
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psutil
import pytest
from sqlalchemy.orm import Session
from support.command import wait_until
from support.examining import doctor
from support.homes import make_home
from support.places import mounted

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.monitoring import health
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.running import queues, recovery
from sms_jobs.jobs.running.origin import Origin, started_at

WITHIN = timedelta(seconds=60)
HOST = socket.gethostname()
ALL_QUEUES = ("cpu", "io", "acquisition")


@dataclass(frozen=True)
class Scene:
    """A home, the time when something goes wrong there, and what puts the machine right again."""

    home: Path
    began: datetime
    patch: pytest.MonkeyPatch
    afterwards: ExitStack


def in_catalogue(do: Callable[[Session, datetime], object]) -> Callable[[Scene], None]:
    """Make a cause of what is written to the catalogue."""

    def cause(scene: Scene) -> None:
        with (
            closing(Catalogue(f"sqlite:///{scene.home / 'catalogue.sqlite'}")) as catalogue,
            catalogue.writing() as session,
        ):
            do(session, scene.began)

    return cause


def in_file(scene: Scene, statement: str) -> None:
    """Have SQLite do what no program of ours would."""
    with closing(sqlite3.connect(scene.home / "catalogue.sqlite")) as connection:
        connection.execute(statement)
        connection.commit()


def work(session: Session, at: datetime) -> None:
    submit(session, "plate", [Request("simulate")], at)


def worker(
    session: Session,
    at: datetime,
    name: str = "w1",
    pid: int = 1,
    serves: tuple[str, ...] = ALL_QUEUES,
    origin: Origin | None = None,
) -> None:
    """Register a worker that is well now, on this host."""
    recovery.register_worker(session, name, HOST, pid, serves, 2, at, origin=origin or Origin("", "", "", 0))
    recovery.beat(session, name, datetime.now(UTC), 2)


def nobody(session: Session, at: datetime) -> None:
    recovery.register_worker(session, "w1", HOST, 1, ALL_QUEUES, 2, at)


def without_processes(session: Session, at: datetime) -> None:
    nobody(session, at)
    recovery.beat(session, "w1", datetime.now(UTC), 0)


def draining(session: Session, at: datetime) -> None:
    worker(session, at)
    recovery.drain(session, "w1")


def held(session: Session, at: datetime) -> None:
    worker(session, at)
    recovery.hold(session, "w1", "the archive cannot be used", None)


def idle_beside_work(session: Session, at: datetime) -> None:
    worker(session, at)
    work(session, at)


def unserved(session: Session, at: datetime) -> None:
    worker(session, at, serves=("io",))
    work(session, at)


def paused(session: Session, at: datetime) -> None:
    worker(session, at)
    work(session, at)
    for queue in ALL_QUEUES:
        queues.pause(session, queue, "the rig is being moved", at)


def hosts_of_one_name(session: Session, at: datetime) -> None:
    here = Origin("machine", "boot", "namespace", 1)
    worker(session, at, "w1", origin=here)
    worker(session, at, "w2", origin=replace(here, boot="later"))


def stopped(scene: Scene) -> None:
    process = scene.afterwards.enter_context(subprocess.Popen(["sleep", "600"]))
    scene.afterwards.callback(process.kill)
    origin = replace(Origin.own(), started=started_at(process.pid) or 0)
    in_catalogue(lambda session, at: worker(session, at, pid=process.pid, origin=origin))(scene)
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_STOPPED)


def counted_wrongly(scene: Scene) -> None:
    in_catalogue(work)(scene)
    in_file(scene, "UPDATE job_count SET jobs = jobs + 1")


def lost_disk(scene: Scene) -> None:
    shutil.rmtree(scene.home / "archive")
    (scene.home / "archive").mkdir()


def instead_of_folder(name: str) -> Callable[[Scene], None]:
    def cause(scene: Scene) -> None:
        shutil.rmtree(scene.home / name, ignore_errors=True)
        (scene.home / name).write_text("no folder")

    return cause


def no_room(scene: Scene) -> None:
    full = types.SimpleNamespace(total=2, used=1, free=1)
    scene.patch.setattr("shutil.disk_usage", lambda path: full)


def on_the_network(scene: Scene) -> None:
    share = types.SimpleNamespace(mountpoint=str(scene.home.resolve()), fstype="nfs4")
    scene.patch.setattr(health.psutil, "disk_partitions", lambda **_: [share])


CAUSES: dict[str, tuple[Callable[[Scene], object], str, str]] = {
    "settings": (lambda s: (s.home / "sms.toml").write_text("workers = 'many'"), "settings", "workers"),
    "no home": (lambda s: shutil.rmtree(s.home), "home and catalogue", "sms init"),
    "emptied catalogue": (
        lambda s: (s.home / "catalogue.sqlite").write_bytes(b""),
        "home and catalogue",
        "sms archive reindex",
    ),
    "messages": (instead_of_folder("messages"), "messages", "does not answer"),
    "archive": (instead_of_folder("archive"), "archive", "archive"),
    "lost disk": (lost_disk, "contents of the catalogue", "mount its disk"),
    "disk in the archive": (
        lambda s: s.afterwards.enter_context(mounted(s.home / "archive" / "other")),
        "archive",
        "another file system",
    ),
    "no room": (no_room, "disk", "make room"),
    "network": (on_the_network, "place of the catalogue", "network file system (nfs4)"),
    "schema": (lambda s: in_file(s, "DROP TABLE schedule"), "schema", "1 difference from this version's"),
    "counts": (counted_wrongly, "counts of jobs", "sms db upgrade"),
    "nobody": (in_catalogue(nobody), "workers", "no worker is alive"),
    "vanished": (in_catalogue(nobody), "workers", "worker w1 on"),
    "draining": (in_catalogue(draining), "workers", "is draining"),
    "held": (in_catalogue(held), "workers", "claims no job: the archive cannot be used"),
    "without processes": (in_catalogue(without_processes), "workers", "none of its 2 processes"),
    "idle beside work": (in_catalogue(idle_beside_work), "workers", "has not taken the next"),
    "unserved queue": (in_catalogue(unserved), "queues", "serves the queue"),
    "paused queue": (in_catalogue(paused), "queues", "the rig is being moved"),
    "stopped process": (stopped, "processes", "kill -CONT"),
    "hosts of one name": (in_catalogue(hosts_of_one_name), "hosts", "hostnamectl"),
}
"""What goes wrong, the check that tells, and words of its finding."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a campaign in it."""
    home = tmp_path_factory.mktemp("sound") / "home"
    make_home(home, {})
    return home


@pytest.mark.parametrize("cause", CAUSES)
def test_a_cause_is_named_a_minute_after_it_began(
    sound: Path, home: Path, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(sound, home, dirs_exist_ok=True)
    happen, check, words = CAUSES[cause]
    with ExitStack() as afterwards:
        happen(Scene(home, datetime.now(UTC) - WITHIN, monkeypatch, afterwards))
        code, found = doctor(home)
    assert code == 6
    assert words in found[check]


def test_every_check_that_can_find_something_has_a_cause(sound: Path) -> None:
    _, found = doctor(sound)
    apart = {"versions", "clock"}
    assert {check for _, check, _ in CAUSES.values()} - {"settings"} == found.keys() - apart
