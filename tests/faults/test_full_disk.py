"""With a full disk nothing is lost: queues wait for room, and a job that fills it leaves nothing behind."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest
from sqlalchemy import select
from support.command import service, sms, wait_until
from support.deployments import Deployment
from support.homes import make_home

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.running import orders, queues
from sms_jobs.records.job import ACTIVE, JobState


@pytest.fixture
def catalogue(home: Path) -> Iterator[Catalogue]:
    """Of a home with the small plate in it."""
    make_home(home, {})
    with closing(Deployment("embedded", home, {}).catalogue()) as opened:
        yield opened


def simulated(catalogue: Catalogue) -> tuple[str, ...]:
    with catalogue.writing() as session:
        return submit(session, "plate", [Request("simulate")], datetime.now(UTC)).job_ids


def jobs(catalogue: Catalogue) -> dict[str, JobRow]:
    with catalogue.reading() as session:
        return {job.id: job for job in session.scalars(select(JobRow))}


def ended(catalogue: Catalogue) -> bool:
    return not any(job.state in ACTIVE for job in jobs(catalogue).values())


def retry(catalogue: Catalogue, job_id: str) -> None:
    with catalogue.writing() as session:
        orders.retry(session, job_id, datetime.now(UTC))


def known(catalogue: Catalogue, of_jobs: Collection[str]) -> set[str]:
    with catalogue.reading() as session:
        return set(session.scalars(select(FileRow.path).where(FileRow.job_id.in_(of_jobs))))


@pytest.mark.long
def test_queues_wait_for_room_and_go_on_by_themselves(home: Path, catalogue: Catalogue) -> None:
    submitted = simulated(catalogue)

    def reasons() -> list[str]:
        with catalogue.reading() as session:
            return [queue.reason for queue in queues.queues(session) if queue.for_room]

    with service(home, {"SMS_LEAST_ROOM_MB": "1e9"}):
        said = wait_until(reasons)
        assert len(said) == 3
        assert all("less than 1e+09 MB (setting least_room_mb)" in reason for reason in said)
        assert "least_room_mb" in sms("queue", "list", "--home", str(home)).stdout
        assert {job.attempts for job in jobs(catalogue).values()} == {0}
    with service(home):
        wait_until(lambda: ended(catalogue))
    assert reasons() == []
    found = jobs(catalogue)
    assert {(found[i].state, found[i].attempts) for i in submitted} == {(JobState.SUCCEEDED, 1)}


@pytest.mark.long
def test_a_job_that_fills_the_disk_leaves_nothing_and_is_tried_again(
    home: Path, catalogue: Catalogue, small_disk: Path
) -> None:
    shutil.copytree(home / "archive", small_disk, dirs_exist_ok=True)

    def left_by_jobs() -> set[str]:
        names = (
            p.relative_to(small_disk).as_posix() for p in small_disk.glob("plate/S*/**/*") if p.is_file()
        )
        return {name for name in names if not name.endswith(".provenance.json")}

    ballast = small_disk / "ballast"
    # A recording takes several times as much as is left.
    ballast.write_bytes(bytes(shutil.disk_usage(small_disk).free - 50_000))
    first, second = simulated(catalogue)
    environment = {"SMS_ARCHIVE": str(small_disk), "SMS_LEAST_ROOM_MB": "0", "SMS_WORKERS": "1"}
    with service(home, environment):
        # While there is none at all it is tried a few times and then fails.
        wait_until(lambda: ended(catalogue))
        for job in jobs(catalogue).values():
            assert (job.state, job.attempts) == (JobState.FAILED, 3)
            assert job.error is not None
            assert "no room" in job.error
            assert "tried 3 times" in job.error
        assert left_by_jobs() == set()
        # Room that is made while it waits is enough.
        retry(catalogue, first)
        wait_until(lambda: jobs(catalogue)[first].message.startswith("waits for room"))
        ballast.unlink()
        retry(catalogue, second)
        wait_until(lambda: ended(catalogue))
    found = jobs(catalogue)
    assert {job.state for job in found.values()} == {JobState.SUCCEEDED}
    assert found[first].attempts > 4
    assert left_by_jobs() == known(catalogue, (first, second)) != set()
