"""What a policy removes, and what it never does, on both deployments."""

from __future__ import annotations

from datetime import datetime, timedelta

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session
from support.archives import Clock, everything, registered, run_jobs

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.jobs.keeping import retention, verification
from sms_jobs.jobs.planning.graph import Request

SECOND = timedelta(seconds=1)


@pytest.fixture
def computed_twice(catalogue: Catalogue, archive: Archive, clock: Clock) -> Archive:
    """An archive in which each shape was computed twice, the second time with another limit."""
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate"), Request("reconstruct")])
    run_jobs(catalogue, archive, clock, [Request("reconstruct", {"maximum_shift_px": 0.4})])
    return archive


def shapes(catalogue: Catalogue) -> list[tuple[int, str]]:
    with catalogue.reading() as session:
        query = select(FileRow.id, FileRow.path).where(FileRow.source == "reconstruct").order_by(FileRow.id)
        return [(number, path) for number, path in session.execute(query)]


def planned(catalogue: Catalogue, clock: Clock, age: timedelta = SECOND) -> set[int]:
    with catalogue.reading() as session:
        return {one.file_id for one in retention.removable(session, clock(), age)}


def test_only_what_is_replaced_old_and_not_needed_goes(
    catalogue: Catalogue, computed_twice: Archive, clock: Clock
) -> None:
    (a, _), (b, _), (c, _), (d, _) = shapes(catalogue)
    assert planned(catalogue, clock) == {a, b}
    assert planned(catalogue, clock, timedelta(days=1)) == set()
    with catalogue.reading() as session:
        assert retention.removable(session, clock(), SECOND, ["strain"]) == []
    with catalogue.writing() as session:
        retention.pin(session, a, "figure 4", clock())
        with pytest.raises(Conflict):
            retention.pin(session, a, "again", clock())
    assert planned(catalogue, clock) == {b}
    before = everything(catalogue)
    gone = retention.remove(catalogue, computed_twice, clock(), SECOND)
    assert [one.file_id for one in gone] == [b]
    assert not computed_twice.store.path(gone[0].path).exists()
    assert [number for number, _ in shapes(catalogue)] == [a, c, d]
    after = everything(catalogue)
    for table in ("files", "statistics", "provenance"):
        assert [row for row in before[table] if row[0] != gone[0].path] == after[table], table
    assert all(v.finding is None for v in verification.check_known(catalogue, computed_twice))
    assert list(verification.check_unknown(catalogue, computed_twice)) == []
    with catalogue.writing() as session:
        retention.unpin(session, a)
        with pytest.raises(NotFound):
            retention.unpin(session, a)
    assert planned(catalogue, clock) == {a}


def test_what_is_gone_is_computed_again_and_not_reused(
    catalogue: Catalogue, computed_twice: Archive, clock: Clock
) -> None:
    (_, first), *_ = shapes(catalogue)
    hashes = {row[0]: row[2] for row in everything(catalogue)["files"]}
    retention.remove(catalogue, computed_twice, clock(), SECOND)
    jobs = run_jobs(catalogue, computed_twice, clock, [Request("reconstruct")])
    with catalogue.reading() as session:
        assert all(session.get_one(JobRow, job).reused_from is None for job in jobs)
    again = {row[0]: row[2] for row in everything(catalogue)["files"]}
    assert hashes[first] in {again[path] for _, path in shapes(catalogue)}


def test_what_anything_that_stays_was_made_from_stays(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate"), Request("reconstruct"), Request("correlate")])
    run_jobs(catalogue, archive, clock, [Request("reconstruct", {"maximum_shift_px": 0.4})])
    # Displacements were computed from the older shapes and are the newest of their kind.
    assert planned(catalogue, clock) == set()
    (older, _), *_ = shapes(catalogue)
    run_jobs(catalogue, archive, clock, [Request("reconstruct")])
    # Computed again, these are the newest; the trial is replaced, and nothing was made from it.
    assert older not in planned(catalogue, clock)
    assert {number for number, _ in shapes(catalogue)[2:4]} == planned(catalogue, clock)


def test_a_result_is_as_young_as_the_last_job_that_was_answered_by_it(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate"), Request("reconstruct")])
    jobs = run_jobs(catalogue, archive, clock, [Request("reconstruct")])
    run_jobs(catalogue, archive, clock, [Request("reconstruct", {"maximum_shift_px": 0.4})])
    first, second, *_ = (number for number, _ in shapes(catalogue))
    with catalogue.reading() as session:
        assert all(session.get_one(JobRow, job).reused_from for job in jobs)
        made = max(session.get_one(FileRow, number).created_at for number in (first, second))
        answered = min(finished(session, job) for job in jobs)
        now = max(finished(session, job) for job in jobs) + timedelta(days=1)
        between = now - made - (answered - made) / 2
        assert made < answered
        assert retention.removable(session, now, between) == []
        assert {one.file_id for one in retention.removable(session, now, SECOND)} == {first, second}


def finished(session: Session, job: str) -> datetime:
    ended = session.get_one(JobRow, job).finished_at
    assert ended is not None
    return ended
