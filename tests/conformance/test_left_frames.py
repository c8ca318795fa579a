"""Frames of recordings that were given up go by policy, those that may still be needed never."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest
from support.jobs import NOW, claim, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.recording import left_frames
from sms_jobs.jobs.running import lifecycle, orders
from sms_jobs.records.job import JobState

DAY = timedelta(days=1)


@pytest.fixture
def spool(tmp_path: Path) -> Path:
    return tmp_path / "spool"


def record(spool: Path, job_id: str) -> None:
    (spool / job_id).mkdir(parents=True)
    (spool / job_id / "C1P1.frames").write_bytes(bytes(100))


def left(spool: Path) -> set[str]:
    return {path.name for path in spool.iterdir()}


@pytest.mark.parametrize(
    "end", [JobState.CANCELLED, JobState.SUCCEEDED, JobState.FAILED, JobState.NEEDS_OPERATOR]
)
def test_frames_go_when_their_recording_was_given_up_or_lies_in_the_archive(
    catalogue: Catalogue, spool: Path, end: JobState
) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    for job_id in (held.job_id, "0123456789abcdef"):  # and one of another catalogue
        record(spool, job_id)
    both = left(spool)
    assert left_frames.remove(catalogue, spool, NOW + 9 * DAY, DAY) == []  # it runs
    with catalogue.writing() as session:
        assert lifecycle.change(session, held.job_id, end, NOW, "", fence=held.fence, finished_at=NOW)

    assert left_frames.remove(catalogue, spool, NOW + DAY, DAY) == []  # not older than a day
    assert left_frames.remove(catalogue, spool, NOW + 2 * DAY, DAY, ["strain"]) == []
    assert left(spool) == both
    gone = left_frames.remove(catalogue, spool, NOW + 2 * DAY, DAY, [held.kind])
    over = end in (JobState.CANCELLED, JobState.SUCCEEDED)
    assert [(one.job_id, one.state, one.size_bytes) for one in gone] == over * [(held.job_id, end, 100)]
    assert left(spool) == both - ({held.job_id} if over else set())


def test_a_recording_that_goes_on_after_all_keeps_its_frames(catalogue: Catalogue, spool: Path) -> None:
    job_id = submit_pipeline(catalogue)[0]
    record(spool, job_id)
    with catalogue.writing() as session:
        orders.cancel(session, job_id, NOW)
        orders.retry(session, job_id, NOW)
    assert left_frames.remove(catalogue, spool, NOW + 2 * DAY, DAY) == []
    assert left(spool) == {job_id}


def test_what_a_removal_that_was_killed_has_left_goes_with_the_next(
    catalogue: Catalogue, spool: Path
) -> None:
    record(spool, ".gone-0123456789abcdef")
    assert left_frames.remove(catalogue, spool, NOW, DAY) == []
    assert left(spool) == set()
