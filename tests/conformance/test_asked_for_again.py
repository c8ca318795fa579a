"""What is asked for again is the newest from then on, whatever was tried in between; on both deployments."""

from __future__ import annotations

from support.archives import Clock, emptied, registered, run_jobs, work_again

from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive
from sms_jobs.catalogue import family, subject_files
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.planning.foreseen import foreseen_reuse
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.records.job import JobState
from sms_jobs.records.subject import Subject

ABOUT = Subject("plate", "S01", "C1P1")
AS_USUAL = Request("reconstruct", states=("S01",))
AS_A_TRIAL = Request("reconstruct", {"minimum_modulation_to_noise": 9.0}, ("S01",))


def newest(catalogue: Catalogue) -> FileRow:
    with catalogue.reading() as session:
        number = subject_files.newest_file(session, "reconstruct", ABOUT, DATASET_MEDIA_TYPE)
        return session.get_one(FileRow, number)


def explained(catalogue: Catalogue, job: str, clock: Clock) -> str:
    with catalogue.reading() as session:
        return " ".join(explanation.explain(session, session.get_one(JobRow, job), clock()))


def test_what_was_tried_in_between_is_not_the_newest_any_more(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate")])
    (first,) = run_jobs(catalogue, archive, clock, [AS_USUAL])
    usual = newest(catalogue)
    (trial,) = run_jobs(catalogue, archive, clock, [AS_A_TRIAL])
    assert newest(catalogue).job_id == trial

    with catalogue.writing() as session:
        (waiting,) = submit(session, "plate", [AS_USUAL], clock()).job_ids
        assert foreseen_reuse(session, [waiting]) == set()
    run_jobs(catalogue, archive, clock, [])
    back = newest(catalogue)
    assert (back.job_id, back.content_hash) == (waiting, usual.content_hash)
    assert back.id != usual.id
    assert f"not reused from job {first[:8]}: other results have come since" in explained(
        catalogue, waiting, clock
    )

    # From then on it is reused; a result of the same contents would not have been in its way.
    (again,) = run_jobs(catalogue, archive, clock, [AS_USUAL])
    with catalogue.reading() as session:
        assert session.get_one(JobRow, again).reused_from == waiting
    emptied(catalogue)
    list(reindexing.reindex(catalogue, archive, reindexing.unknown_files(catalogue, archive)))
    work_again(catalogue, clock)
    assert newest(catalogue).path == back.path


def test_what_builds_on_it_is_that_of_what_was_asked_for(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate"), AS_USUAL])
    usual = newest(catalogue)
    run_jobs(catalogue, archive, clock, [AS_A_TRIAL])
    run_jobs(catalogue, archive, clock, [AS_USUAL])
    (mesh,) = run_jobs(catalogue, archive, clock, [Request("mesh", states=("S01",))])
    with catalogue.reading() as session:
        assert session.get_one(JobRow, mesh).state is JobState.SUCCEEDED
        assert usual.content_hash in family.input_hashes(session, mesh).values()
