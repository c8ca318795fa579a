"""What was planned is entered only where it still holds by then; the same on both deployments."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import pytest
from sqlalchemy import select, update
from support.jobs import JOBS, NOW, add_calibration_file, claim, state, submit_pipeline

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.errors import PlanOutdated
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.keeping import retention
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import Draft, draft, enter, submit_to
from sms_jobs.jobs.running import lifecycle
from sms_jobs.records.job import JobState
from sms_jobs.virtual_rig.campaigns import small_plate

LATER = NOW + timedelta(minutes=1)
RECONSTRUCT = [Request("reconstruct", states=("S00",), views=("C1P1",))]


def drafted(catalogue: Catalogue, *requests: Request) -> Draft:
    with catalogue.reading() as session:
        return draft(session, "plate", requests, LATER)


def entered(catalogue: Catalogue, planned: Draft) -> tuple[str, ...]:
    with catalogue.writing() as session:
        return enter(session, planned).job_ids


def test_a_plan_is_entered_as_it_was_made(catalogue: Catalogue) -> None:
    jobs = submit_pipeline(catalogue)
    planned = drafted(catalogue, *RECONSTRUCT)
    assert planned.producers
    assert set(planned.producers) <= set(jobs)
    (job_id,) = entered(catalogue, planned)
    assert state(catalogue, job_id) is JobState.WAITING


@pytest.mark.parametrize("end", [JobState.SUCCEEDED, JobState.FAILED])
def test_one_that_would_wait_for_a_job_that_has_ended_is_planned_again(
    catalogue: Catalogue, end: JobState
) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    planned = drafted(catalogue, *RECONSTRUCT)
    assert planned.producers == (held.job_id,)
    with catalogue.writing() as session:
        lifecycle.change(session, held.job_id, end, LATER, "it ended", finished_at=LATER)
    with pytest.raises(PlanOutdated, match="ends just now; submit them again"):
        entered(catalogue, planned)
    with catalogue.reading() as session:
        assert sum(inquiry.counts(session).values()) == JOBS


def test_one_that_would_wait_for_a_job_that_just_ends_waits_for_nobody(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    planned = drafted(catalogue, *RECONSTRUCT)
    if catalogue.dialect == "sqlite":
        pytest.skip("one writes at a time")
    with catalogue.writing() as session:
        lifecycle.change(session, held.job_id, JobState.FAILED, LATER, "it ends", finished_at=LATER)
        with pytest.raises(PlanOutdated):
            entered(catalogue, planned)


def test_a_job_that_ends_sees_who_has_just_begun_to_wait_for_it(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    held = claim(catalogue)
    assert held is not None
    (job_id,) = entered(catalogue, drafted(catalogue, *RECONSTRUCT))
    with catalogue.writing() as session:
        lifecycle.change(session, held.job_id, JobState.FAILED, LATER, "broken", finished_at=LATER)
    assert state(catalogue, job_id) is JobState.SKIPPED


def test_a_campaign_that_was_changed_is_planned_again(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    planned = drafted(catalogue, Request("simulate"))
    with catalogue.writing() as session:
        row = campaigns.campaign_row(session, "plate")
        record = campaigns.definition(row)
        campaigns.define(row, replace(record, states=record.states[:1]))
    with pytest.raises(PlanOutdated, match="was changed by someone else"):
        entered(catalogue, planned)
    done = submit_to(catalogue, "plate", [Request("simulate")], LATER)
    assert len(done.job_ids) == 1


def test_a_file_that_is_gone_is_not_referred_to(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        campaigns.add_campaign(session, small_plate("plate")[1], NOW)
        add_calibration_file(session, "plate")
        numbers = campaigns.state_ids(session, campaigns.campaign_id(session, "plate"))
        file = FileRow(
            source="measurement",
            path="plate/S00/C1P1.h5",
            content_hash="m",
            size_bytes=1,
            media_type="application/x-hdf5",
            created_at=NOW,
            campaign_id=campaigns.campaign_id(session, "plate"),
            state_id=numbers["S00"],
            view="C1P1",
        )
        session.add(file)
        session.flush()
        number = file.id
    planned = drafted(catalogue, *RECONSTRUCT)
    with catalogue.writing() as session:
        retention.forget(session, [number])
    with pytest.raises(PlanOutdated, match="is gone meanwhile"):
        entered(catalogue, planned)
    with catalogue.reading() as session:
        assert inquiry.counts(session) == {}
        assert session.scalars(select(DependencyRow)).all() == []


def test_a_dry_run_tells_what_the_submission_would(catalogue: Catalogue) -> None:
    from sms_jobs.jobs.planning.chosen import submitted
    from sms_jobs.jobs.planning.estimates import estimate, estimate_planned

    ids = submit_pipeline(catalogue)
    with catalogue.writing() as session:
        session.execute(
            update(JobRow)
            .where(JobRow.id.in_(ids))
            .values(
                state=JobState.SUCCEEDED,
                worker_id="w1",
                started_at=NOW,
                finished_at=NOW + timedelta(seconds=3),
            )
        )
    planned = drafted(catalogue, Request("simulate"), Request("pipeline"))
    with catalogue.reading() as session:
        before = estimate_planned(session, planned, LATER, 2)
    with catalogue.writing() as session:
        done = enter(session, planned)
    with catalogue.reading() as session:
        assert estimate(session, submitted(done), LATER, 2) == before
    assert before.jobs == JOBS
    assert before.seconds is not None
