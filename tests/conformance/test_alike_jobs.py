"""Of jobs that compute the same at the same time one does, and the others take its result."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from support.archives import Clock, registered, run_jobs, runner
from support.jobs import claim, events, submit_pipeline
from support.remembered import Remembering

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import InvalidInput, LeaseLost
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Terms, submit
from sms_jobs.jobs.running import alike, lifecycle
from sms_jobs.records.job import JobState

ASKED = Request("reconstruct", states=("S01",))
KEY = "0123456789abcdef" * 4


def asked(catalogue: Catalogue, clock: Clock, **terms: Any) -> str:
    with catalogue.writing() as session:
        (job_id,) = submit(session, "plate", [ASKED], clock(), Terms(**terms)).job_ids
    return job_id


def job(catalogue: Catalogue, job_id: str) -> JobRow:
    with catalogue.reading() as session:
        return session.get_one(JobRow, job_id)


@pytest.fixture
def meanwhile(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> Callable[[Callable[[], object]], None]:
    """Let something happen while the next job computes, once another process has looked for jobs."""
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate")])
    computes = Remembering._sealed_outputs
    happens: list[Callable[[], object]] = []

    def outputs(self: Remembering, *arguments: Any) -> Iterator[Any]:
        for happening in [happens.pop()] if happens else []:
            runner(catalogue, archive, clock).run_queued()
            happening()
        yield from computes(self, *arguments)

    monkeypatch.setattr(Remembering, "_sealed_outputs", outputs)
    return happens.append


def test_the_second_waits_for_the_first_and_takes_its_result(
    catalogue: Catalogue, archive: Archive, clock: Clock, meanwhile: Callable[[Callable[[], object]], None]
) -> None:
    first, second = asked(catalogue, clock), asked(catalogue, clock)
    stood: list[tuple[JobState, int, str]] = []

    def look() -> None:
        row = job(catalogue, second)
        stood.append((row.state, row.attempts, row.message))

    meanwhile(look)
    runner(catalogue, archive, clock).run_queued()
    assert stood == [(JobState.QUEUED, 0, f"job {first[:8]} computes the same, and its result is waited for")]
    assert job(catalogue, first).reused_from is None
    assert job(catalogue, second).reused_from == first
    assert job(catalogue, second).attempts == 1
    told = [(event.state, event.message) for event in events(catalogue, second)]
    assert ("queued", stood[0][2]) in told
    assert told[-1] == ("succeeded", f"reused from job {first[:8]}")


def test_the_second_computes_where_the_first_fails(
    catalogue: Catalogue, archive: Archive, clock: Clock, meanwhile: Callable[[Callable[[], object]], None]
) -> None:
    first, second = asked(catalogue, clock), asked(catalogue, clock)

    def fail() -> None:
        raise InvalidInput("what is wrong with it")

    meanwhile(fail)
    runner(catalogue, archive, clock).run_queued()
    assert job(catalogue, first).state is JobState.FAILED
    row = job(catalogue, second)
    assert (row.state, row.reused_from) == (JobState.SUCCEEDED, None)


def test_what_is_to_be_computed_anew_waits_for_nobody_and_others_for_it(
    catalogue: Catalogue, archive: Archive, clock: Clock, meanwhile: Callable[[Callable[[], object]], None]
) -> None:
    first, anew = asked(catalogue, clock), asked(catalogue, clock, use_cache=False)
    ended: list[JobState] = []
    meanwhile(lambda: ended.append(job(catalogue, anew).state))
    runner(catalogue, archive, clock).run_queued()
    assert ended == [JobState.SUCCEEDED]
    assert [job(catalogue, one).reused_from for one in (first, anew)] == [None, None]

    anew, later = asked(catalogue, clock, use_cache=False), asked(catalogue, clock)
    meanwhile(lambda: ended.append(job(catalogue, later).state))
    runner(catalogue, archive, clock).run_queued()
    assert ended[1:] == [JobState.SUCCEEDED]  # there is a result already


def test_of_two_that_begin_at_the_same_moment_the_second_sees_the_first(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    first, second = claim(catalogue), claim(catalogue)
    assert first is not None
    assert second is not None
    seen: list[str | None] = []

    def begin() -> None:
        with catalogue.writing() as session:
            seen.append(alike.take(session, second.job_id, second.fence, KEY, giving_way=True))

    with catalogue.writing() as session:
        assert alike.take(session, first.job_id, first.fence, KEY, giving_way=True) is None
        session.flush()
        other = threading.Thread(target=begin)
        other.start()
        time.sleep(0.3)
        assert seen == []
    other.join(30.0)
    assert seen == [first.job_id]


def test_an_attempt_that_does_not_run_any_more_takes_nothing_up(catalogue: Catalogue, clock: Clock) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        assert lifecycle.change(session, held.job_id, JobState.QUEUED, clock(), "", fence=held.fence)
        with pytest.raises(LeaseLost, match="newer attempt"):
            alike.take(session, held.job_id, held.fence, KEY, giving_way=True)
    assert job(catalogue, held.job_id).reuse_key is None
