"""What a monitoring system is told, over HTTP and on paper."""

from __future__ import annotations

import re
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psutil
import pytest
import sqlalchemy
from prometheus_client import generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector
from sqlalchemy import update
from support.command import SMS, inside
from support.deployments import Deployment
from support.jobs import NOW, claim, submit_pipeline

from sms_jobs import bootstrap
from sms_jobs.app.home.service import metrics
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.monitoring.metrics import gather
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.running import lifecycle, orders, queues, recovery
from sms_jobs.jobs.scheduling import schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.schedules import Order
from sms_jobs.records.job import JobState

_SAMPLE = re.compile(r'([a-z_]+)(\{(?:[a-z]+="(?:[^"\\]|\\.)*",?)+\})? (\S+)')


def read(text: str) -> dict[str, float]:
    """Read the text format as its description has it: anything that is neither sample nor comment fails."""
    found = {}
    declared: set[str] = set()
    for line in text.splitlines():
        if line.startswith("# "):
            _, word, name, *_ = line.split(" ", 3)
            assert word in ("HELP", "TYPE")
            declared.add(name)
            continue
        sample = _SAMPLE.fullmatch(line)
        assert sample is not None, line
        assert sample[1] in declared
        series = sample[1] + (sample[2] or "")
        assert series not in found
        found[series] = float(sample[3])
    assert text.endswith("\n")
    return found


@pytest.fixture
def lived_in(home: Path) -> Deployment:
    """A home with a job that runs and many that wait."""
    return make(Deployment("embedded", home, {}))


def make(deployment: Deployment) -> Deployment:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        bootstrap.initialise(deployment.home)
    catalogue = deployment.catalogue()
    with catalogue.writing() as session:
        recovery.register_worker(session, "w1", "here", 1, ["cpu", "io", "acquisition"], 2, NOW)
    submit_pipeline(catalogue)
    claim(catalogue, NOW + timedelta(seconds=10))
    with catalogue.writing() as session:
        queues.pause(session, "io", "the disk is full", NOW, for_room=True)
    order = Order("plate", (Request("simulate"),))
    schedules.add(catalogue, "nightly", parse_expression("every 60s", "UTC"), order, NOW)
    catalogue.close()
    return deployment


@dataclass(frozen=True)
class Given(Collector):
    """Numbers of a moment of the test's own."""

    found: list[GaugeMetricFamily]

    def collect(self) -> list[GaugeMetricFamily]:
        return self.found


def numbers(catalogue: Catalogue, folder: Path, now: datetime) -> dict[str, float]:
    with catalogue.reading() as session:
        found = gather(session, Archive(FolderStore(folder)), now)
        return read(generate_latest(Given(found)).decode())


@pytest.mark.parametrize("name", ["embedded", "grown"])
def test_the_numbers_are_those_of_the_catalogue(
    request: pytest.FixtureRequest, name: str, home: Path
) -> None:
    grown = name == "grown"
    url = {"SMS_DATABASE_URL": request.getfixturevalue("fresh_postgresql_url")} if grown else {}
    catalogue = make(Deployment(name, home, url)).catalogue()
    now = NOW + timedelta(seconds=100)
    found = numbers(catalogue, home, now)
    assert found['sms_jobs{kind="simulate",state="running"}'] == 1
    assert found['sms_jobs{kind="simulate",state="queued"}'] == 1
    assert found['sms_running_seconds{kind="simulate"}'] == 90  # claimed 10 s after NOW, asked 100 s after
    assert found['sms_queue_jobs{queue="acquisition"}'] == 1
    assert found['sms_queue_oldest_seconds{queue="acquisition"}'] == 100
    assert found['sms_queue_oldest_seconds{queue="cpu"}'] == 0
    assert (found['sms_queue_paused{queue="io"}'], found['sms_queue_paused{queue="cpu"}']) == (1, 0)
    assert found["sms_workers_alive"] == 0  # its last beat is 100 s old
    assert found['sms_worker_beat_seconds{host="here",worker="w1"}'] == 100
    assert found['sms_worker_jobs{host="here",worker="w1"}'] == 1
    assert found['sms_schedule_lag_seconds{schedule="nightly"}'] == 40  # due after 60 s, asked after 100 s
    assert found['sms_archive_files{source="calibration"}'] == 1
    assert found["sms_archive_free_bytes"] > 0

    # A job that was queued again counts from then on; a worker that has ended in order is not missed.
    with catalogue.writing() as session:
        held = claim_all(catalogue, session, now)
        lifecycle.change(session, held, JobState.FAILED, now, "", finished_at=now)
        orders.retry(session, held, now + timedelta(seconds=1))
        session.execute(update(WorkerRow).values(draining=True))
    found = numbers(catalogue, home, now + timedelta(seconds=6))
    assert found['sms_queue_oldest_seconds{queue="acquisition"}'] == 5
    assert not [series for series in found if series.startswith("sms_worker_")]
    catalogue.close()


def claim_all(catalogue: Catalogue, session: object, now: datetime) -> str:
    """Claim the job that is still queued and return its id."""
    held = lifecycle.claim(session, ["acquisition"], "w1", 1, now)  # type: ignore[arg-type]
    assert held is not None
    return held.job_id


@contextmanager
def serving(home: Path) -> Iterator[tuple[str, psutil.Process]]:
    """Run `sms metrics` on a free port; give its address."""
    process = subprocess.Popen(
        [*SMS, "metrics", "--port", "0", "--home", str(home)], stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    try:
        said = process.stderr.readline()
        found = re.search(r"http://\S+/metrics", said)
        assert found is not None, said
        yield found[0], psutil.Process(process.pid)
    finally:
        process.terminate()
        process.communicate(timeout=30)


def get(url: str) -> tuple[str, str]:
    with urllib.request.urlopen(url, timeout=30) as response:
        return response.headers["Content-Type"], response.read().decode()


def test_they_are_served_on_loopback_alone(lived_in: Deployment) -> None:
    with serving(lived_in.home) as (url, process):
        kind, text = get(url)
        assert kind.startswith("text/plain; version=0.0.4")
        found = read(text)
        assert found["sms_catalogue_up"] == 1
        assert found['sms_jobs{kind="simulate",state="running"}'] == 1
        listening = [c.laddr.ip for c in process.net_connections() if c.status == psutil.CONN_LISTEN]
        assert listening == ["127.0.0.1"]
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get(url.replace("/metrics", "/../etc/passwd"))
        port = url.rpartition(":")[2].removesuffix("/metrics")
        refused = inside("metrics", "--port", port, "--home", str(lived_in.home))
        assert (refused.returncode, f"port {port}" in refused.stderr) == (4, True)


def test_a_catalogue_that_is_away_is_a_number(
    fresh_postgresql_url: str, home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = {"SMS_DATABASE_URL": fresh_postgresql_url}
    make(Deployment("grown", home, environment))
    name = sqlalchemy.make_url(fresh_postgresql_url).database
    server = sqlalchemy.create_engine(
        sqlalchemy.make_url(fresh_postgresql_url).set(database="postgres"),
        isolation_level="AUTOCOMMIT",
        poolclass=sqlalchemy.pool.NullPool,
    )
    for variable, value in environment.items():
        monkeypatch.setenv(variable, value)
    with bootstrap.services(home) as services, server.connect() as connection:
        assert read(metrics(services))["sms_catalogue_up"] == 1
        connection.execute(sqlalchemy.text(f"ALTER DATABASE {name} ALLOW_CONNECTIONS false"))
        ended = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = :name"
        connection.execute(sqlalchemy.text(ended), {"name": name})
        assert read(metrics(services)) == {"sms_catalogue_up": 0}
        connection.execute(sqlalchemy.text(f"ALTER DATABASE {name} ALLOW_CONNECTIONS true"))
        assert read(metrics(services))["sms_catalogue_up"] == 1


def test_once_prints_and_tells_no_secret(lived_in: Deployment) -> None:
    secret = {"SMS_BROKER_URL": "redis://:open-sesame@127.0.0.1:1/0"}
    done = inside("metrics", "--once", "--home", str(lived_in.home), environment=secret)
    assert (done.returncode, done.stderr) == (0, "")
    assert read(done.stdout)["sms_catalogue_up"] == 1
    assert "open-sesame" not in done.stdout
    assert str(lived_in.home) not in done.stdout


def test_an_empty_home_has_numbers_too(home: Path) -> None:
    bootstrap.initialise(home)
    found = numbers(Deployment("embedded", home, {}).catalogue(), home, datetime.now(UTC))
    assert found["sms_workers_alive"] == 0
    assert not [series for series in found if series.startswith("sms_jobs{")]
