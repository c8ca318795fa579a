"""What every test may ask for: servers, a home of its own, seeded randomness.

`ops/test.sh` starts private servers and names them in SMS_TEST_POSTGRESQL_URL and SMS_TEST_REDIS_URL.
Without them the tests that need a server are skipped, or fail where CI=true.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit, urlunsplit

import hypothesis
import numpy as np
import pytest
import redis
import sqlalchemy
from argon2 import PasswordHasher
from support import catalogues
from support.missing import do_without
from xdist.scheduler import LoadFileScheduling

# Deadlines would time the tests on a busy machine; fixed seeds make a failure repeat itself.
hypothesis.settings.register_profile("sms", deadline=None, derandomize=True, print_blob=True)
hypothesis.settings.load_profile("sms")


# Thousands of tests are millions of objects that all stay: they are not looked through for garbage again and
# again while they are loaded, nor by every full collection later.
gc.disable()


def pytest_collection_finish() -> None:
    """Leave what was collected out of every later look for garbage, and look for it more rarely.

    Looking as often as Python does by itself, after 700 new objects, took an eighth of what tests of the
    catalogue need: each look goes through what they have loaded since.
    """
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


SHARING = ("test_calibrate_kinds", "test_observe_bar", "test_observe_board", "test_session_adjustment")
"""Files whose tests begin with the same rendered session, which takes ten seconds to make."""


class _Together(LoadFileScheduling):
    """Keeps the tests of a file in one process, and so those of files that share what is costly to make."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return "sharing" if Path(file).stem in SHARING else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distribute files as `--dist loadfile` does."""
    return _Together(config, log) if config.getvalue("dist") == "loadfile" else None


def _server(variable: str, what: str) -> str:
    url = os.environ.get(variable, "")
    if not url:
        do_without(f"needs a {what} server: run ops/test.sh, or set {variable}")
    return url


@pytest.fixture(autouse=True)
def _settings_of_the_developer_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in os.environ:
        if name.startswith("SMS_") and not name.startswith("SMS_TEST_"):
            monkeypatch.delenv(name)
    monkeypatch.setenv("MPLBACKEND", "Agg")


@pytest.fixture(autouse=True)
def _passwords_cost_little(monkeypatch: pytest.MonkeyPatch) -> None:
    # A hash is to cost tenths of a second and 64 MB, and tests make hundreds. Services hash as always.
    quick = PasswordHasher(time_cost=1, memory_cost=1024, parallelism=1)
    monkeypatch.setattr("sms_jobs.app.accounts.people._hasher", lambda: quick)


@pytest.fixture
def rng() -> np.random.Generator:
    """A seeded generator, the same for every test."""
    return np.random.default_rng(20_031)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """An empty folder for a home of this test alone."""
    folder = tmp_path / "home"
    folder.mkdir()
    return folder


@pytest.fixture(scope="session")
def postgresql_url() -> str:
    """The URL of a PostgreSQL server, with an account that may create databases."""
    return _server("SMS_TEST_POSTGRESQL_URL", "PostgreSQL")


@pytest.fixture(scope="session")
def postgresql(postgresql_url: str) -> Iterator[sqlalchemy.Engine]:
    """The PostgreSQL server, for statements that are no part of a transaction."""
    engine = sqlalchemy.create_engine(postgresql_url, isolation_level="AUTOCOMMIT", pool_pre_ping=True)
    try:
        yield engine
    finally:
        engine.dispose()


@pytest.fixture
def fresh_postgresql_url(postgresql: sqlalchemy.Engine) -> Iterator[str]:
    """The URL of an empty PostgreSQL database that belongs to this test alone."""
    with catalogues.database(postgresql) as url:
        yield url


@pytest.fixture(scope="session")
def _migrated_database(postgresql: sqlalchemy.Engine) -> Iterator[str]:
    with catalogues.database(postgresql) as url:
        catalogues.migrate(url)
        yield sqlalchemy.make_url(url).database or ""


@pytest.fixture
def migrated_postgresql_url(postgresql: sqlalchemy.Engine, _migrated_database: str) -> Iterator[str]:
    """As `fresh_postgresql_url`, with the newest schema and nothing in it."""
    with catalogues.database(postgresql, _migrated_database) as url:
        yield url


@pytest.fixture(scope="session")
def migrated_sqlite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An SQLite catalogue with the newest schema and nothing in it, to be copied."""
    return catalogues.migrated_file(tmp_path_factory.mktemp("migrated"))


@pytest.fixture(scope="session")
def redis_server_url() -> str:
    """The URL of a Redis server whose contents the tests may delete."""
    return _server("SMS_TEST_REDIS_URL", "Redis")


@pytest.fixture
def redis_url(redis_server_url: str) -> Iterator[str]:
    """The URL of a Redis database that is empty before and after the test, and of this test process alone."""
    process = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    parts = urlsplit(redis_server_url)
    number = int(parts.path.strip("/") or "0") + int(process)
    url = urlunsplit(parts._replace(path=f"/{number}"))
    with redis.Redis.from_url(url) as client:
        client.flushdb()
        try:
            yield url
        finally:
            client.flushdb()
