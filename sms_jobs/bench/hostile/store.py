"""Homes for tries: made once with results of every kind, and lent to one batch after the other."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.pool import NullPool

from sms_jobs import bootstrap
from sms_jobs.bench.servers import POSTGRESQL, fresh_postgresql
from sms_jobs.catalogue import copying
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.every import METADATA
from sms_jobs.errors import ConfigurationError
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.runner import Runner
from sms_jobs.virtual_rig.campaigns import small_plate

_QUEUES = ["cpu", "io", "acquisition"]


class Books(Protocol):
    """Looks at a catalogue from outside the program."""

    def state(self) -> object:
        """Return what differs after every change that was committed."""

    def paths(self) -> set[str]:
        """Return the files of the archive that it knows."""


class Store(Protocol):
    """Lends a home to each batch."""

    def lend(self, place: Path) -> dict[str, str]:
        """Make the home `home` in a folder; return the environment that goes with it."""

    def release(self, place: Path) -> None:
        """Take back what was lent beside the folder."""

    def open(self, environment: dict[str, str]) -> Books:
        """Open the catalogue of the home of this folder."""


def make_first(home: Path) -> None:
    """Make a home whose campaign `plate` has been measured, processed and reported, and has jobs left."""
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        calibration, campaign = small_plate("plate")
        now = datetime.now(UTC)
        register_campaign(services.catalogue, services.archive, campaign, calibration, now)
        with services.catalogue.writing() as session:
            submit(session, "plate", [Request("simulate"), Request("pipeline")], now)
            recovery.register_worker(session, "w1", "here", os.getpid(), _QUEUES, 1, now)
        Runner(
            services.catalogue,
            services.archive,
            _QUEUES,
            "w1",
            "here",
            1,
            services.settings.job_log_folder,
            services.stations,
            lambda: datetime.now(UTC),
            least_room_mb=0.0,
        ).run_queued()
        with services.catalogue.writing() as session:
            submit(session, "plate", [Request("mesh")], now)


def _linked(first: Path, place: Path) -> None:
    """Copy a home; its sealed files, which nobody changes, are the same by hard links."""
    shutil.copytree(first, place / "home", ignore=shutil.ignore_patterns("archive", "*-wal", "*-shm"))
    shutil.copytree(first / "archive", place / "home" / "archive", copy_function=os.link)


@dataclass(frozen=True)
class Embedded:
    """Homes whose catalogue is SQLite."""

    first: Path

    def lend(self, place: Path) -> dict[str, str]:
        """Copy the home."""
        _linked(self.first, place)
        return {}

    def release(self, place: Path) -> None:
        """Nothing is beside the folder."""

    def open(self, environment: dict[str, str]) -> Books:
        """Open the file."""
        return _SqliteBooks(sqlite3.connect("home/catalogue.sqlite"))


@dataclass(frozen=True)
class _SqliteBooks:
    connection: sqlite3.Connection

    def state(self) -> object:
        """Return SQLite's own count of what others have committed."""
        return self.connection.execute("PRAGMA data_version").fetchone()

    def paths(self) -> set[str]:
        """Return the files that it knows."""
        return {path for (path,) in self.connection.execute("SELECT path FROM file")}


@dataclass(frozen=True)
class Grown:
    """Homes whose catalogue is a database of PostgreSQL, copied from a template."""

    first: Path
    template: str

    def lend(self, place: Path) -> dict[str, str]:
        """Copy the home and the database."""
        _linked(self.first, place)
        url = make_url(self.template)
        name = self._name(place)
        with self._server() as server:
            server.execute(text(f"CREATE DATABASE {name} TEMPLATE {url.database}"))
        return {"SMS_DATABASE_URL": url.set(database=name).render_as_string(hide_password=False)}

    def release(self, place: Path) -> None:
        """Drop the database."""
        with self._server() as server:
            server.execute(text(f"DROP DATABASE IF EXISTS {self._name(place)} WITH (FORCE)"))

    def open(self, environment: dict[str, str]) -> Books:
        """Connect to the database."""
        return _PostgresqlBooks(create_engine(environment["SMS_DATABASE_URL"], isolation_level="AUTOCOMMIT"))

    def _name(self, place: Path) -> str:
        return f"{make_url(self.template).database}_{place.name.replace('-', '_')}"

    @contextmanager
    def _server(self) -> Iterator[Any]:
        engine = create_engine(os.environ[POSTGRESQL], isolation_level="AUTOCOMMIT", poolclass=NullPool)
        with engine.connect() as connection:
            yield connection
        engine.dispose()


@dataclass(frozen=True)
class _PostgresqlBooks:
    engine: Engine

    def state(self) -> object:
        """Return which version of each row is where."""
        rows = " UNION ALL ".join(
            f"SELECT '{t.name}', md5(string_agg(xmin::text || ctid, ',' ORDER BY ctid)) FROM \"{t.name}\""  # noqa: S608
            for t in METADATA.sorted_tables
        )
        with self.engine.connect() as connection:
            return [tuple(row) for row in connection.execute(text(rows))]

    def paths(self) -> set[str]:
        """Return the files that it knows."""
        with self.engine.connect() as connection:
            return set(connection.scalars(text("SELECT path FROM file")))


@contextmanager
def opened(deployment: str, first: Path) -> Iterator[Store]:
    """Give copies of a home on a deployment, embedded or grown."""
    if deployment == "embedded":
        yield Embedded(first)
        return
    with fresh_postgresql() as url:
        if url is None:
            raise ConfigurationError(f"the environment names no PostgreSQL server: set {POSTGRESQL}")
        source = Catalogue(f"sqlite:///{first / 'catalogue.sqlite'}")
        with closing(source), closing(Catalogue(url, create=True)) as target:
            copying.prepare(target)
            for _ in copying.copy(source, target):
                pass
        yield Grown(first, url)
