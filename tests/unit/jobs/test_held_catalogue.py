"""A catalogue into which nobody can write is found by the command that its refusal names."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.jobs.monitoring import health


def test_a_lock_that_is_held_is_found_with_what_to_do(home: Path) -> None:
    initialised(home)
    file = home / "catalogue.sqlite"
    with bootstrap.services(home) as services, closing(sqlite3.connect(file, isolation_level=None)) as other:
        assert health.held(services.catalogue, 0.1) is None
        other.execute("BEGIN IMMEDIATE")
        found = health.held(services.catalogue, 0.1)
        assert found is not None
        assert f"'fuser -v {file}' names who has it open" in found
        other.execute("ROLLBACK")
        assert health.held(services.catalogue, 0.1) is None
        with services.catalogue.writing():
            pass
