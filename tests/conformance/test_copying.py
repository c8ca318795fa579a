"""A catalogue goes from either database to the other with every row, and work goes on there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import delete, func, insert, select, text, update
from support.command import answer, inside, service
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import NOW, claim, submit_pipeline

from sms_jobs.catalogue import copying, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.every import written_tables
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import LockRow, QueueRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import ConfigurationError, Conflict, OtherFormat
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.running import lifecycle, queues
from sms_jobs.jobs.scheduling import firing, schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.schedules import Order


def rows(catalogue: Catalogue) -> dict[str, list[tuple[Any, ...]]]:
    """Return every row of every table, in the order of the keys."""
    with catalogue.reading() as session:
        return {
            table.name: [
                tuple(r) for r in session.execute(select(table).order_by(*table.primary_key.columns))
            ]
            for table in written_tables()
        }


@pytest.fixture
def other_url(request: pytest.FixtureRequest, deployment: Deployment, tmp_path: Path) -> str:
    """The URL of an empty database of the other sort."""
    if deployment.name == "grown":
        return f"sqlite:///{tmp_path / 'other.sqlite'}"
    url: str = request.getfixturevalue("fresh_postgresql_url")
    return url


@pytest.fixture
def other(other_url: str) -> Iterator[Catalogue]:
    """An empty database of the other sort."""
    with closing(Catalogue(other_url, create=True)) as opened:
        yield opened


@pytest.fixture
def lived_in(catalogue: Catalogue) -> Catalogue:
    """A catalogue in which something of everything has happened, and whose service has ended."""
    submit_pipeline(catalogue)
    done, failed = claim(catalogue), claim(catalogue)
    assert done is not None
    assert failed is not None
    with catalogue.writing() as session:
        lifecycle.succeed(session, done, NOW, "took 1 s", reuse_key="k" * 64)
        lifecycle.change(session, failed.job_id, lifecycle.JobState.FAILED, NOW, "ünlucky", error="why\n%s")
        # A job that refers to one with a larger id, and one that refers to a smaller: no order suits both.
        first, last = session.execute(select(func.min(JobRow.id), func.max(JobRow.id))).one()
        session.execute(update(JobRow).where(JobRow.id == first).values(reused_from=last))
        session.execute(update(JobRow).where(JobRow.id == last).values(reused_from=first))
        queues.pause(session, "io", "the disk is full", NOW, for_room=True)
        session.add(LockRow(device="camera/C1", job_id=done.job_id, fence=1, taken_at=NOW))
        session.execute(update(WorkerRow).values(draining=True))
    every = parse_expression("every 60s", "Europe/Berlin")
    schedules.add(catalogue, "hourly", every, Order("plate", (Request("simulate"),)), NOW)
    firing.fire_due(catalogue, NOW + timedelta(seconds=61))
    return catalogue


def copy(source: Catalogue, target: Catalogue) -> list[copying.Copied]:
    copying.prepare(target)
    return list(copying.copy(source, target))


def test_every_row_arrives_and_the_copy_numbers_on(lived_in: Catalogue, other: Catalogue) -> None:
    steps = copy(lived_in, other)
    before = rows(lived_in)
    assert rows(other) == before
    # Tables without rows would show nothing here.
    assert {"job", "event", "dependency", "schedule_fire", "lock", "queue", "outbox"} <= {
        name for name, found in before.items() if found
    }
    assert steps[-1].done == steps[-1].total == sum(map(len, before.values()))
    assert [s.done for s in steps] == sorted(s.done for s in steps)
    with other.writing() as session:
        job_id = session.scalar(select(JobRow.id).limit(1))
        event = EventRow(job_id=job_id, at=NOW, state=lifecycle.JobState.QUEUED, attempt=0, message="")
        session.add(event)
        session.flush()
        assert event.id == max(row[0] for row in before["event"]) + 1
    assert submit_pipeline(other, "another")


def test_the_way_back_leads_to_the_same_rows(lived_in: Catalogue, other: Catalogue, tmp_path: Path) -> None:
    copy(lived_in, other)
    with closing(Catalogue(f"sqlite:///{tmp_path / 'third.sqlite'}", create=True)) as third:
        copy(other, third)
        assert rows(third) == rows(lived_in)


def test_a_large_catalogue_goes_in_several_batches(lived_in: Catalogue, other: Catalogue) -> None:
    with lived_in.writing() as session:
        some = {"content_hash": "h", "size_bytes": 1, "media_type": "x", "created_at": NOW, "source": "s"}
        session.execute(insert(FileRow), [some | {"path": f"{i}"} for i in range(5000)])
    steps = copy(lived_in, other)
    assert sum(step.table == "file" for step in steps) == 3  # 5,001 rows by 2,000
    assert rows(other) == rows(lived_in)


def test_what_is_not_empty_is_refused_and_kept(lived_in: Catalogue, other: Catalogue) -> None:
    copying.prepare(other)
    with other.writing() as session:
        session.add(QueueRow(name="cpu", paused_at=None, reason="", for_room=False))
    before = rows(other)
    with pytest.raises(Conflict, match="not empty: it has 1 row in 'queue'"):
        copy(lived_in, other)
    assert rows(other) == before


def test_a_database_of_something_else_is_refused(other: Catalogue) -> None:
    with other.writing() as session:
        session.execute(text("CREATE TABLE bookings (id integer)"))
    with pytest.raises(ConfigurationError, match="'bookings'"):
        copying.prepare(other)


def test_another_schema_is_refused(other: Catalogue) -> None:
    schema.upgrade(other)
    with other.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '0999'"))
    with pytest.raises(OtherFormat, match="newer"):
        copying.prepare(other)
    with other.writing() as session:
        session.execute(text(f"UPDATE alembic_version SET version_num = '{schema.newest_revision()}'"))
        session.execute(text("ALTER TABLE queue DROP COLUMN reason"))
    with pytest.raises(ConfigurationError, match="not this version's"):
        copying.prepare(other)


def test_a_copy_that_is_broken_off_leaves_nothing(lived_in: Catalogue, other: Catalogue) -> None:
    copying.prepare(other)
    steps = copying.copy(lived_in, other)
    for step in steps:
        if step.table == "event":
            break
    steps.close()  # type: ignore[attr-defined]
    assert not any(rows(other).values())


@pytest.mark.parametrize(
    ("draining", "age_s", "running", "says"),
    [
        (False, 10, False, "the service runs: worker w1"),
        (False, 100, True, "have 1 job running"),
        (True, 10, True, "have 1 job running"),
        (False, 100, False, ""),
        (True, 10, False, ""),
    ],
)
def test_a_service_that_runs_is_refused(
    catalogue: Catalogue, draining: bool, age_s: float, running: bool, says: str
) -> None:
    submit_pipeline(catalogue)
    if running:
        claim(catalogue)
    now: datetime = NOW + timedelta(seconds=age_s)
    with catalogue.writing() as session:
        session.execute(update(WorkerRow).values(draining=draining, beat_at=NOW))
    if says:
        with pytest.raises(Conflict, match=says):
            copying.require_idle(catalogue, now)
    else:
        copying.require_idle(catalogue, now)


@pytest.fixture
def empty(catalogue: Catalogue) -> Catalogue:
    """A catalogue without any row."""
    with catalogue.writing() as session:
        session.execute(delete(WorkerRow))
    return catalogue


def test_nothing_becomes_nothing(empty: Catalogue, other: Catalogue) -> None:
    assert copy(empty, other) == []
    assert submit_pipeline(other)


@pytest.mark.long
def test_work_goes_on_in_the_copied_catalogue(home: Path, fresh_postgresql_url: str, redis_url: str) -> None:
    embedded: dict[str, str] = {}
    make_home(home, embedded)

    def run(environment: dict[str, str], *arguments: str) -> Any:
        return answer(*arguments, "--home", str(home), environment=environment)

    with service(home):
        run(embedded, "job", "submit", "simulate", "-c", "plate", "--wait")
        refused = inside("db", "copy", fresh_postgresql_url, "--home", str(home))
        assert (refused.returncode, "the service runs" in refused.stderr) == (4, True)
    # Some jobs are still to be run: they are to be run after the move, with what was recorded before it.
    jobs = run(embedded, "job", "submit", "reconstruct", "-c", "plate")["jobs"]
    secret = fresh_postgresql_url.replace("sms@", "sms:open-sesame@")
    told = inside("db", "copy", "--json", "--home", str(home), environment={"SMS_COPY_TO_URL": secret})
    assert told.returncode == 0, told.stderr
    assert "open-sesame" not in told.stdout + told.stderr
    grown = {"SMS_DATABASE_URL": fresh_postgresql_url, "SMS_BROKER_URL": redis_url}
    with service(home, grown):
        assert run(grown, "job", "wait", *jobs)["jobs"] == {"succeeded": len(jobs)}
    assert run(embedded, "status")["jobs"]["queued"] > 0  # the old catalogue is as it was
    assert inside("archive", "verify", "--home", str(home), environment=grown).returncode == 0

    back = f"sqlite:///{home / 'back.sqlite'}"
    run(grown, "db", "copy", back)
    with closing(Catalogue(back)) as there, closing(Catalogue(fresh_postgresql_url)) as here:
        assert rows(there) == rows(here)
    returned = {"SMS_DATABASE_URL": back}
    # Everything has been computed before: it is found again in the catalogue that came back.
    again = run(returned, "job", "submit", "reconstruct", "-c", "plate")["jobs"]
    with service(home, returned):
        run(returned, "job", "wait", *again)
    listed = {job["id"]: job for job in run(returned, "job", "list", "--limit", "1000")}
    assert all(listed[i]["reused_from"] in jobs for i in again)
