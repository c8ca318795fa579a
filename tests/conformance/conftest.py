"""Every test here runs on both deployments: SQLite with files, and PostgreSQL with Redis."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.archives import Clock
from support.deployments import Deployment
from support.jobs import NOW

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.running import recovery


@pytest.fixture(params=["embedded", "grown"])
def deployment(request: pytest.FixtureRequest, home: Path, migrated_sqlite: Path) -> Deployment:
    """A home of its own on either deployment, whose catalogue has the newest schema and nothing in it."""
    if request.param == "embedded":
        shutil.copyfile(migrated_sqlite, home / "catalogue.sqlite")
        return Deployment("embedded", home, {})
    urls = {
        "SMS_DATABASE_URL": request.getfixturevalue("migrated_postgresql_url"),
        "SMS_BROKER_URL": request.getfixturevalue("redis_url"),
    }
    return Deployment("grown", home, urls)


@pytest.fixture
def catalogue(deployment: Deployment) -> Iterator[Catalogue]:
    """An empty catalogue with the newest schema and one worker, `w1`."""
    opened = deployment.catalogue()
    with opened.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 2, NOW)
    try:
        yield opened
    finally:
        opened.close()


@pytest.fixture
def archive(deployment: Deployment) -> Archive:
    """The archive of the home, with nothing in it."""
    return Archive(FolderStore(deployment.home / "archive"))


@pytest.fixture
def clock() -> Clock:
    """A second later whenever it is asked."""
    return Clock()
