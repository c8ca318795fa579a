"""Two hosts share a campaign, and are restarted one after the other while it runs.

They are two homes on one machine with one database, one broker and one archive: they are apart in all but
their clock, their name and their processes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from contextlib import ExitStack, closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil
import pytest
from sqlalchemy import select
from support.command import answer, inside, service, wait_until
from support.homes import make_home

from sms_jobs import bootstrap
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import EventRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.records.job import JobState


class Host:
    """A home and the service in it."""

    def __init__(self, home: Path, environment: Mapping[str, str], catalogue: Catalogue) -> None:
        self.home = home
        self.environment = environment
        self.catalogue = catalogue
        self._running = ExitStack()

    def start(self) -> str:
        """Start the service; return the id of its worker once that can claim jobs."""
        process: psutil.Process = self._running.enter_context(service(self.home, self.environment))

        def registered() -> str | None:
            with self.catalogue.reading() as session:
                ready = (WorkerRow.pid == process.pid, WorkerRow.processes > 0)
                return session.scalar(select(WorkerRow.id).where(*ready))

        found: str = wait_until(registered)
        return found

    def end(self) -> None:
        """End the service in order."""
        self._running.close()

    def run(self, *arguments: str) -> Any:
        return answer(*arguments, "--home", str(self.home), environment=self.environment)

    def say(self, *arguments: str) -> str:
        done = inside(*arguments, "--home", str(self.home), environment=self.environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def drain(self, worker: str) -> datetime:
        """Drain a worker, whichever host it is on; return when that was done."""
        done = inside("worker", "drain", worker, "--home", str(self.home), environment=self.environment)
        assert done.returncode == 0, done.stderr
        return datetime.now(UTC)


def claims(catalogue: Catalogue, worker: str) -> list[datetime]:
    """Return when a worker claimed jobs."""
    with catalogue.reading() as session:
        claimed = EventRow.message.startswith(f"claimed by worker {worker}")
        return list(session.scalars(select(EventRow.at).where(EventRow.state == JobState.RUNNING, claimed)))


def test_a_campaign_outlives_the_restart_of_either_host(
    fresh_postgresql_url: str, redis_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {
        "SMS_DATABASE_URL": fresh_postgresql_url,
        "SMS_BROKER_URL": redis_url,
        "SMS_ARCHIVE": str(tmp_path / "shared"),
        "SMS_WORKERS": "1",
    }
    make_home(tmp_path / "a", environment)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    bootstrap.initialise(tmp_path / "b")
    with closing(Catalogue(fresh_postgresql_url)) as catalogue, ExitStack() as at_the_end:
        a, b = (Host(tmp_path / name, environment, catalogue) for name in "ab")
        for host in (a, b):
            at_the_end.callback(host.end)
        first, second = a.start(), b.start()
        jobs = a.run("job", "submit", "simulate", "reconstruct", "-c", "plate")["jobs"]
        # On a busy machine one host may be done before the other has woken: then there is more to do.
        while not all(claims(catalogue, worker) for worker in (first, second)):
            assert len(jobs) < 200
            a.run("job", "wait", *jobs)
            jobs += a.run("job", "submit", "reconstruct", "-c", "plate")["jobs"]

        # One after the other, each drained from the other host.
        drained = {first: b.drain(first)}
        a.end()
        third = a.start()
        drained[second] = a.drain(second)
        b.end()
        # Whatever the second one has left, there is something for the third to do.
        jobs += a.run("job", "submit", "reconstruct", "-c", "plate")["jobs"]
        assert a.run("job", "wait", *jobs)["jobs"] == {"succeeded": len(jobs)}

        for worker, at in drained.items():
            assert max(claims(catalogue, worker)) < at
        done = {worker: len(claims(catalogue, worker)) for worker in (first, second, third)}
        assert sum(done.values()) == len(jobs)  # nobody ran what another had run
        assert all(done.values())
        listed = a.run("job", "list", "--limit", "1000")
        assert {job["attempts"] for job in listed} == {1}
        assert a.run("worker", "list")[-1]["id"] == third
        # What a job has said is read on either host, whichever ran it.
        for host in (a, b):
            for job in (jobs[0], jobs[-1]):
                assert f"job {job}: " in host.say("job", "logs", job)

    files = a.run("data", "find", "--limit", "1000")
    seen = Counter((f["source"], f["subject"], f["path"].rpartition("-")[2], f["media_type"]) for f in files)
    assert set(seen.values()) == {1}
    assert a.run("archive", "verify")["findings"] == b.run("archive", "verify", "--quick")["findings"] == []
    assert {f["path"] for f in files} == {
        str(path.relative_to(tmp_path / "shared"))
        for path in (tmp_path / "shared").rglob("*")
        if path.is_file() and ".logs" not in path.parts and not path.name.endswith(".provenance.json")
    }
