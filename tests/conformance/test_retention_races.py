"""A file that somebody begins to need while a policy lets files go is kept or refused, never pulled away."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import delete, event, insert, select, text
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session
from support.command import wait_until
from support.deployments import Deployment
from support.jobs import NOW, claim, ids, submit_pipeline

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import CalibrationRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow
from sms_jobs.catalogue.tables.files import FileRow, ResultRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.jobs.keeping import retention
from sms_jobs.jobs.results import reuse
from sms_jobs.jobs.running import lifecycle
from sms_jobs.records.job import JobState

LATER = NOW + timedelta(days=2)
DAY = timedelta(days=1)

Need = Callable[[Session, int], None]


def superseded_files(catalogue: Catalogue, archive: Archive, count: int) -> list[tuple[int, str]]:
    """Add results that one newer has replaced, each of a kind of its own so that a policy can name it."""
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        campaign = session.scalars(select(CampaignRow.id)).one()
        _, newer, *_, older = session.scalars(
            select(JobRow.id).order_by(JobRow.position)
        )  # nobody needs the last
        files = []
        for number in range(count + 1):
            path = f"plate/result-{number}.h5"
            file = FileRow(
                source="reconstruct",
                path=path,
                content_hash=str(number),
                size_bytes=1,
                media_type="application/x-hdf5",
                created_at=NOW,
                campaign_id=campaign,
                job_id=newer if number == count else older,
            )
            session.add(file)
            session.flush()
            session.add(ResultRow(file_id=file.id, kind=f"kind-{number}", kind_version=1))
            archive.store.path(path).parent.mkdir(exist_ok=True)
            archive.store.path(path).write_bytes(b"x")
            files.append((file.id, path))
    return files[:-1]


def pins(session: Session, file_id: int) -> None:
    retention.pin(session, file_id, "figure 4", LATER)


def uses(session: Session, file_id: int) -> None:
    """Submit a job that opens it."""
    waiting = session.scalars(select(JobRow.id).order_by(JobRow.position.desc()).limit(1)).one()
    values = {"job_id": waiting, "role": f"r{file_id}", "source": "reconstruct", "subject": "plate"}
    session.execute(insert(DependencyRow), [values | {"file_id": file_id}])


def certifies(session: Session, file_id: int) -> None:
    rig = session.scalars(select(RigRow.id)).one()
    session.add(CalibrationRow(rig_id=rig, file_id=file_id, valid_from=LATER, origin="a session", sensors={}))


def needed(catalogue: Catalogue, need: Need, file_id: int) -> bool:
    """Begin to need a file; False when it is gone already."""
    try:
        with catalogue.writing() as session:
            need(session, file_id)
    except (NotFound, IntegrityError):
        return False
    return True


class Between:
    """Starts something else after one statement of a transaction, and gives it a moment.

    Where the other waits for a lock of the transaction, that goes on before it.
    """

    def __init__(self, statement: int, start: Callable[[], Future[bool]]) -> None:
        self._left = statement
        self._start = start
        self.other: Future[bool] | None = None

    def __call__(self, *_: Any) -> None:
        if self._left == 0:
            self.other = self._start()
            with suppress(TimeoutError):
                self.other.result(timeout=0.05)
        self._left -= 1


@pytest.mark.long
@pytest.mark.parametrize("need", [pins, uses, certifies])
def test_whoever_comes_between_choice_and_removal_is_seen_or_refused(
    catalogue: Catalogue, deployment: Deployment, need: Need
) -> None:
    archive = Archive(FolderStore(deployment.home / "archive"))
    files = superseded_files(catalogue, archive, 48)
    outcomes = []
    # After each statement of the removal in turn, on a file of its own, until there is none so late.
    with closing(deployment.catalogue()) as other, ThreadPoolExecutor(1) as pool:
        for statement, (file_id, path) in enumerate(files):
            between = Between(statement, lambda file=file_id: pool.submit(needed, other, need, file))
            event.listen(catalogue.engine, "after_cursor_execute", between)
            try:
                gone = retention.remove(catalogue, archive, LATER, DAY, [f"kind-{statement}"])
            finally:
                event.remove(catalogue.engine, "after_cursor_execute", between)
            if between.other is None:
                break
            kept = between.other.result()
            outcomes.append(kept)
            assert kept is (gone == [])
            assert archive.store.path(path).exists() is kept
            with catalogue.reading() as session:
                assert (session.get(FileRow, file_id) is not None) is kept
    assert len(outcomes) < len(files), "more statements than files: give the test more"
    assert False in outcomes
    # SQLite lets only one write at a time: who comes in between always comes too late.
    assert (True in outcomes) is (catalogue.dialect == "postgresql")


@pytest.mark.parametrize("need", [pins, uses, certifies])
def test_what_is_needed_but_not_yet_committed_is_kept(
    catalogue: Catalogue, deployment: Deployment, need: Need
) -> None:
    archive = Archive(FolderStore(deployment.home / "archive"))
    (file_id, path), (_, unneeded) = superseded_files(catalogue, archive, 2)
    with closing(deployment.catalogue()) as other, ThreadPoolExecutor(1) as pool:
        with catalogue.writing() as session:
            need(session, file_id)
            session.flush()
            removal = pool.submit(retention.remove, other, archive, LATER, DAY)
            if catalogue.dialect == "postgresql":
                removal.result(timeout=30)  # it does not wait
        assert [one.path for one in removal.result(timeout=30)] == [unneeded]
    assert archive.store.path(path).exists()


def test_what_a_waiting_job_will_get_from_a_reused_one_is_kept(
    catalogue: Catalogue, deployment: Deployment
) -> None:
    archive = Archive(FolderStore(deployment.home / "archive"))
    ((file_id, path),) = superseded_files(catalogue, archive, 1)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        earlier = session.get_one(FileRow, file_id).job_id
        # Long ago, so that it is not the time of the reuse that keeps the file.
        assert lifecycle.succeed(session, held, NOW, "reused", reuse_key="k", reused_from=earlier)
        waits = [i for i in session.scalars(select(JobRow.id)) if held.job_id in ids(session, i)]
        assert waits
    assert retention.remove(catalogue, archive, LATER, DAY) == []
    assert archive.store.path(path).exists()


def told(earlier: reuse.Earlier | None) -> tuple[str, tuple[str, ...]] | None:
    """Return the job of an earlier result and the paths of its files."""
    return earlier and (earlier.job_id, tuple(file.path for file in earlier.files))


def test_a_result_that_is_being_reused_is_kept_and_one_that_went_is_not_reused(
    catalogue: Catalogue, deployment: Deployment
) -> None:
    archive = Archive(FolderStore(deployment.home / "archive"))
    ((file_id, path),) = superseded_files(catalogue, archive, 1)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        assert lifecycle.succeed(session, held, NOW, "done", reuse_key="same")
        session.get_one(FileRow, file_id).job_id = held.job_id
        session.execute(delete(DependencyRow))
    if catalogue.dialect == "postgresql":
        with closing(deployment.catalogue()) as other, catalogue.writing() as session:
            assert told(reuse.earlier_success(session, "same")) == (held.job_id, (path,))
            assert retention.remove(other, archive, LATER, DAY) == []
    with catalogue.writing() as session:
        assert told(reuse.earlier_success(session, "same")) == (held.job_id, (path,))
    assert [one.path for one in retention.remove(catalogue, archive, LATER, DAY)] == [path]
    with catalogue.writing() as session:
        assert reuse.earlier_success(session, "same") is None


@pytest.mark.parametrize("deployment", ["grown"], indirect=True)  # SQLite has one writer at a time
@pytest.mark.parametrize("goes", [True, False])
def test_a_result_of_which_one_file_goes_meanwhile_is_not_reused(
    catalogue: Catalogue, deployment: Deployment, goes: bool
) -> None:
    archive = Archive(FolderStore(deployment.home / "archive"))
    (first, path), (_, second_path) = superseded_files(catalogue, archive, 2)
    with catalogue.writing() as session:
        made_by = session.get_one(FileRow, first).job_id
        job = session.get_one(JobRow, made_by)
        job.state, job.reuse_key, job.finished_at = JobState.SUCCEEDED, "same", NOW

    def ask(of: Catalogue) -> tuple[str, tuple[str, ...]] | None:
        with of.writing() as session:
            return told(reuse.earlier_success(session, "same"))

    def somebody_waits() -> bool:
        with catalogue.reading() as session:
            locks = "SELECT count(*) FROM pg_locks WHERE NOT granted"
            return bool(session.scalar(text(locks)))

    with closing(deployment.catalogue()) as other, ThreadPoolExecutor(1) as pool:
        with suppress(Conflict), catalogue.writing() as session:
            retention.forget(session, [first])
            asked = pool.submit(ask, other)
            wait_until(somebody_waits, timeout=30)
            if not goes:
                raise Conflict("the policy thinks better of it")
        assert asked.result(timeout=30) == (None if goes else (made_by, (path, second_path)))
    assert (ask(catalogue) is None) is goes
