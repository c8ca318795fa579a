"""The transaction that ends a job claims the next one, and nothing is lost when that breaks."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import event, select, text
from support.archives import Clock, registered, runner

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.saved_queries import SavedQueryRow
from sms_jobs.errors import CommitInDoubt, ServerUnreachable
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.running import recovery
from sms_jobs.records.job import JobState

on_postgresql = pytest.mark.parametrize("deployment", ["grown"], indirect=True)


@pytest.fixture
def plate(catalogue: Catalogue, archive: Archive, clock: Clock) -> None:
    """A campaign of two states, both submitted."""
    registered(catalogue, archive, clock)
    submit_again(catalogue, clock)


def submit_again(catalogue: Catalogue, clock: Clock) -> None:
    with catalogue.writing() as session:
        submit(session, "plate", [Request("simulate")], clock())


def states(catalogue: Catalogue) -> list[JobState]:
    with catalogue.reading() as session:
        return list(session.scalars(select(JobRow.state).order_by(JobRow.position)))


def before_sealing(monkeypatch: pytest.MonkeyPatch, happens: Any) -> None:
    """Let something happen once, before a job seals what it has made."""
    seal = Archive.seal_dataset

    def interrupted(self: Archive, *arguments: Any) -> Any:
        monkeypatch.setattr(Archive, "seal_dataset", seal)
        happens()
        return seal(self, *arguments)

    monkeypatch.setattr(Archive, "seal_dataset", interrupted)


@pytest.mark.usefixtures("plate")
def test_a_reused_job_takes_one_transaction(catalogue: Catalogue, archive: Archive, clock: Clock) -> None:
    worker = runner(catalogue, archive, clock)
    worker.run_queued()
    submit_again(catalogue, clock)
    submit_again(catalogue, clock)
    commits: list[object] = []
    event.listen(catalogue.engine, "commit", commits.append)
    worker.run_queued()
    assert states(catalogue) == 6 * [JobState.SUCCEEDED]
    assert len(commits) == 1 + 4  # the claim of the first


@pytest.mark.usefixtures("plate")
def test_a_job_that_fails_keeps_nobody_from_the_next(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ValueError("nobody has foreseen this")

    before_sealing(monkeypatch, fail)
    runner(catalogue, archive, clock).run_queued()
    assert states(catalogue) == [JobState.FAILED, JobState.SUCCEEDED]


@pytest.mark.usefixtures("plate")
def test_a_draining_worker_ends_its_job_and_takes_no_other(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drain() -> None:
        with catalogue.writing() as session:
            recovery.drain(session, "w1")

    before_sealing(monkeypatch, drain)
    runner(catalogue, archive, clock).run_queued()
    assert states(catalogue) == [JobState.SUCCEEDED, JobState.QUEUED]


@on_postgresql
@pytest.mark.usefixtures("plate")
@pytest.mark.parametrize("committed", [True, False])
def test_a_commit_in_doubt_is_asked_about_and_loses_and_doubles_nothing(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch, committed: bool
) -> None:
    dialect = catalogue.engine.dialect
    commit = dialect.do_commit
    ending: list[str] = []

    def break_the_end_of_a_job(connection: Any) -> None:
        if ending and committed:
            commit(connection)
        if ending:
            monkeypatch.undo()
            connection.dbapi_connection.close()
            raise dialect.loaded_dbapi.OperationalError("the server closed the connection unexpectedly")
        commit(connection)

    monkeypatch.setattr(dialect, "do_commit", break_the_end_of_a_job)
    event.listen(
        catalogue.engine,
        "before_cursor_execute",
        lambda *said: ending.append(said[2]) if "INSERT INTO file" in said[2] else None,
    )
    runner(catalogue, archive, clock).run_queued()
    assert ending
    assert states(catalogue) == [JobState.SUCCEEDED, JobState.SUCCEEDED]
    with catalogue.reading() as session:
        known = session.scalars(select(FileRow.path).where(FileRow.job_id.is_not(None))).all()
    lie_there = {
        str(p.relative_to(archive.store.root)) for p in (archive.store.root / "plate").rglob("simulate-*.h5")
    }
    assert len(known) == len(lie_there) == 2
    assert set(known) == lie_there


@on_postgresql
def test_a_server_that_goes_away_leaves_doubt_at_the_commit_alone(catalogue: Catalogue) -> None:
    def write(then: Any) -> None:
        with catalogue.writing() as session:
            session.add(SavedQueryRow(name="kept", text="strain", saved_at=Clock()()))
            session.flush()
            number = session.scalar(text("SELECT pg_backend_pid()"))
            with catalogue.reading() as other:
                assert other.scalar(text("SELECT pg_terminate_backend(:number, 5000)"), {"number": number})
            then(session)

    with pytest.raises(ServerUnreachable) as met:
        write(then=lambda session: session.execute(select(JobRow.id)))
    assert not isinstance(met.value, CommitInDoubt)
    with pytest.raises(CommitInDoubt):
        write(then=lambda session: None)
    with catalogue.reading() as session:
        assert session.scalars(select(SavedQueryRow)).all() == []
