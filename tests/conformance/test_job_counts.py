"""The catalogue knows how many jobs are in each state, whoever changes them and however many at a time."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from alembic import command
from sqlalchemy import delete, func, insert, select, text, update
from support.deployments import Deployment
from support.jobs import JOBS, NOW, claim, submit_pipeline

from sms_jobs.app.home import database
from sms_jobs.catalogue import job_counts, schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.job_counts import JobCountRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow, OutboxRow
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.monitoring import health
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.running import lifecycle
from sms_jobs.records.job import JobState


def counted(catalogue: Catalogue) -> dict[str, int]:
    """Return how many jobs are in each state, having seen that this is true."""
    with catalogue.reading() as session:
        states = Counter(state.value for state in session.scalars(select(JobRow.state)))
        found = inquiry.counts(session)
        assert found == states
        assert not job_counts.differ(session)
        by_campaign = job_counts.counted(session, JobCountRow.campaign_id)
        of_each = [inquiry.counts(session, Chosen(campaign_id=number)) for (number,) in by_campaign]
        assert sum((Counter(one) for one in of_each), Counter()) == states
    return found


def parts_of(catalogue: Catalogue) -> int:
    """Return how many rows the counts take."""
    with catalogue.reading() as session:
        return session.scalar(select(func.count()).select_from(JobCountRow)) or 0


def test_every_change_of_a_job_is_counted(catalogue: Catalogue) -> None:
    assert counted(catalogue) == {}
    submit_pipeline(catalogue)
    before = counted(catalogue)
    assert sum(before.values()) == JOBS
    held = claim(catalogue)
    assert held is not None
    assert counted(catalogue)["running"] == 1
    with catalogue.writing() as session:
        lifecycle.succeed(session, held, NOW, "took 1 s", reuse_key="k" * 64)
    assert counted(catalogue)["succeeded"] == 1
    with catalogue.writing() as session:
        session.execute(update(JobRow).where(JobRow.state == JobState.QUEUED).values(queue="io"))
        session.execute(update(JobRow).values(progress=0.5))
    counted(catalogue)
    with catalogue.writing() as session:
        for row in (EventRow, OutboxRow, DependencyRow, JobRow):
            session.execute(delete(row))
    assert counted(catalogue) == {}


def test_what_is_rolled_back_is_not_counted(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    before = counted(catalogue)

    def give_up() -> None:
        with catalogue.writing() as session:
            session.execute(update(JobRow).values(state=JobState.FAILED))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        give_up()
    assert counted(catalogue) == before


def test_many_change_jobs_at_a_time_and_are_folded_meanwhile(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(state=JobState.QUEUED))

    def work(_number: int) -> int:
        done = 0
        while (held := claim(catalogue)) is not None:
            with catalogue.writing() as session:
                done += lifecycle.change(session, held.job_id, JobState.FAILED, NOW, "", fence=held.fence)
            job_counts.fold(catalogue)
        return done

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(work, range(4))) == JOBS
    assert counted(catalogue) == {"failed": JOBS}


def test_folding_leaves_a_row_for_what_there_is(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(state=JobState.QUEUED))
        session.execute(update(JobRow).values(state=JobState.SUCCEEDED))
    with catalogue.reading() as session:
        different = session.execute(select(JobRow.campaign_id, JobRow.kind, JobRow.queue).distinct()).all()
    before = counted(catalogue)
    job_counts.fold(catalogue)
    assert counted(catalogue) == before == {"succeeded": JOBS}
    assert parts_of(catalogue) == len(different)


def test_two_who_change_jobs_do_not_wait_for_each_other(catalogue: Catalogue) -> None:
    if catalogue.dialect == "sqlite":
        return  # where one at a time writes
    first, second = sorted(submit_pipeline(catalogue))[:2]
    job_counts.fold(catalogue)
    with catalogue.writing() as one, catalogue.writing() as other:
        other.execute(text("SET LOCAL lock_timeout = '1s'"))
        for session, job_id in ((one, first), (other, second)):
            session.execute(update(JobRow).where(JobRow.id == job_id).values(state=JobState.CANCELLED))
    assert counted(catalogue)["cancelled"] == 2


def test_an_older_catalogue_is_counted_when_it_is_upgraded(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        configuration = schema.configuration()
        configuration.attributes["connection"] = session.connection()
        command.downgrade(configuration, "0101")
        session.execute(update(JobRow).values(state=JobState.CANCELLED))
    schema.upgrade(catalogue)
    assert counted(catalogue) == {"cancelled": JOBS}
    assert schema.differences_from_models(catalogue) == []


def test_a_trigger_that_is_gone_is_noticed(catalogue: Catalogue) -> None:
    table = " ON job" if catalogue.dialect == "postgresql" else ""
    with catalogue.writing() as session:
        session.execute(text(f"DROP TRIGGER job_count_changed{table}"))
    assert schema.differences_from_models(catalogue) == ["no trigger job_count_changed"]


def test_counts_that_are_wrong_are_found_and_mended(deployment: Deployment, catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        strange = {"campaign_id": 1, "kind": "strain", "queue": "cpu", "state": JobState.LOST}
        session.execute(insert(JobCountRow).values(part=0, jobs=7, **strange))
    with catalogue.reading() as session:
        assert inquiry.counts(session)["lost"] == 7
        found = health.counts_of_jobs(session)
    assert found is not None
    assert "'sms db upgrade'" in found
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        database.upgrade(deployment.home)
    with closing(deployment.catalogue()) as again:
        assert "lost" not in counted(again)
