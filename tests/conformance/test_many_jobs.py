"""Thousands of jobs cost few statements, and none that grows with them; the same on both deployments."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select
from support.jobs import NOW, claim, events
from support.people import SOMEBODY
from support.statements import heard

from sms_jobs.app.work.waiting import wait_for
from sms_jobs.archive import Archive, MemoryStore
from sms_jobs.bench.large import many_jobs
from sms_jobs.bench.large.many_jobs import SECONDS, fill_queue, name_of
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.parts import AT_ONCE
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import InvalidInput, WaitTimedOut
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning import chosen, coming
from sms_jobs.jobs.planning.chosen import Chosen
from sms_jobs.jobs.planning.estimates import estimate, outlook
from sms_jobs.jobs.running import crowds, doorbell, lifecycle, queues, recovery
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.estimates import Outlook
from sms_jobs.settings import Settings

MANY = 1200
"""More than are looked at one by one here, and than a statement is given values."""
FEW = 500
MOST_VALUES = AT_ONCE + 100
"""Those of a part of a list, and what else is asked."""
CAMPAIGN_NAME = name_of(0)


@pytest.fixture
def filled(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> Catalogue:
    """A catalogue with many jobs that have not ended, all of one campaign."""
    monkeypatch.setattr(coming, "MOST", FEW)
    fill_queue(catalogue, MANY, NOW)
    return catalogue


def status(catalogue: Catalogue) -> Outlook:
    with catalogue.reading() as session:
        inquiry.counts(session)
        return outlook(session, Chosen(), 2)


def of_campaign(catalogue: Catalogue) -> Outlook:
    with catalogue.reading() as session:
        scope = chosen.of_campaign(session, CAMPAIGN_NAME)
        inquiry.list_jobs(session, campaign=CAMPAIGN_NAME)
        return outlook(session, scope, 2)


def waited_for(catalogue: Catalogue) -> None:
    with catalogue.reading() as session:
        some = chosen.active_now(session, CAMPAIGN_NAME)
    with pytest.raises(WaitTimedOut, match=f"{MANY} of {MANY} jobs"):
        wait_for(
            Services(Settings(home=Path(), workers=2), catalogue, Archive(MemoryStore()), SOMEBODY), some, 0.0
        )


def recovered(catalogue: Catalogue) -> None:
    """What a supervisor does again and again."""
    with catalogue.writing() as session:
        recovery.recover(session, NOW, "here", 3, lambda pid, began: True)
    with catalogue.reading() as session:
        doorbell.unheard(session)
        queues.queues(session)
    recovery.queue_ready(catalogue, NOW)


def test_questions_about_many_are_as_short_as_those_about_few(filled: Catalogue) -> None:
    questions: list[Callable[[Catalogue], object]] = [status, of_campaign, waited_for, recovered]
    for question in questions:
        with heard(filled) as found:
            question(filled)
        assert found.most_values <= MOST_VALUES, question.__name__
        assert len(found.statements) <= 60, question.__name__
    ahead = status(filled).estimate
    assert ahead.jobs == MANY
    assert ahead.looked_at is not None
    assert ahead.looked_at < MANY / 2
    each = sum(SECONDS.values()) / len(SECONDS)
    # Two places would do it. Of the 300 sampled jobs or so the mean scatters by 7 s / sqrt(300), 5 % of it.
    assert ahead.seconds == pytest.approx(MANY * each / 2, rel=0.25)
    with filled.reading() as session:
        queued = select(JobRow.id).where(JobRow.state == JobState.QUEUED).order_by(JobRow.position)
        first = session.scalars(queued.limit(8)).all()
        # Those at the front of many are looked at one by one: not many come before them.
        assert estimate(session, chosen.by_ids(first), NOW, 2).looked_at is None


def test_a_campaign_is_cancelled_and_tried_again_part_by_part(filled: Catalogue) -> None:
    held = claim(filled)
    assert held is not None
    with filled.reading() as session:
        some = chosen.active_now(session, CAMPAIGN_NAME)
    with heard(filled) as found:
        assert crowds.cancel(filled, some, NOW) == MANY
    assert found.most_values <= MOST_VALUES
    assert len(found.statements) < MANY / 10
    with filled.reading() as session:
        assert inquiry.counts(session, some) == {"running": 1, "cancelled": MANY - 1}
        one = session.scalars(select(JobRow.id).where(JobRow.state == JobState.CANCELLED).limit(1)).one()
        with pytest.raises(lifecycle.Cancelled):
            lifecycle.report_progress(session, held, 0.5, "half")
    assert [e.state for e in events(filled, one)][-1] == "cancelled"
    with heard(filled) as found:
        assert crowds.retry(filled, CAMPAIGN_NAME, NOW) == MANY - 1
    assert found.most_values <= MOST_VALUES
    with filled.reading() as session:
        counted = inquiry.counts(session, some)
        outbox = doorbell.unsent(session, limit=MANY)
    # One of four needs nothing; the first of these runs.
    assert counted == {"running": 1, "queued": MANY // 4 - 1, "waiting": MANY * 3 // 4}
    assert len({job_id for _, job_id, _ in outbox}) == MANY // 4


def test_all_that_depends_on_one_job_is_skipped_however_much_that_is(filled: Catalogue) -> None:
    from sqlalchemy import update

    from sms_jobs.catalogue.tables.queues import DependencyRow

    held = claim(filled)
    assert held is not None
    with filled.writing() as session:
        session.execute(update(DependencyRow).values(producer_id=held.job_id))
        with heard(filled) as found:
            lifecycle.change(session, held.job_id, JobState.FAILED, NOW, "broken", finished_at=NOW)
        assert inquiry.counts(session)["skipped"] == MANY * 3 // 4
    assert found.most_values <= MOST_VALUES


def test_a_campaign_is_moved_and_ranked_by_one_statement_each(filled: Catalogue) -> None:
    with filled.reading() as session:
        some = chosen.active_now(session, CAMPAIGN_NAME)
        before = session.scalars(select(JobRow.id).order_by(JobRow.position)).all()
    with heard(filled) as found, filled.writing() as session:
        assert queues.move(session, some, "front") == MANY
        assert queues.set_priority(session, some, 5) == MANY
    assert len(found.statements) <= 8
    with filled.reading() as session:
        after = session.scalars(select(JobRow.id).where(JobRow.priority == 5).order_by(JobRow.position)).all()
    assert after == [job_id for job_id in before if job_id in set(after)]


def test_what_had_ended_before_is_not_waited_for(filled: Catalogue) -> None:
    with filled.reading() as session:
        some = chosen.active_now(session, CAMPAIGN_NAME)
        assert inquiry.counts(session)["succeeded"] > 0
        assert sum(inquiry.counts(session, some).values()) == MANY
    held = claim(filled)
    assert held is not None
    with filled.writing() as session:
        lifecycle.succeed(session, held, NOW, "took 1 s", reuse_key="k" * 64)
        assert inquiry.counts(session, some)["succeeded"] == 1
        assert sum(inquiry.counts(session, some).values()) == MANY


def test_too_many_names_are_refused() -> None:
    with pytest.raises(InvalidInput, match="1001 jobs are named, and at most 1000 can be"):
        chosen.by_ids(["a"] * 1001)


def test_campaigns_are_listed_by_a_few_statements(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_jobs, "CAMPAIGN", 16)
    fill_queue(catalogue, 20, NOW - timedelta(days=3))
    with catalogue.reading() as session, heard(catalogue) as found:
        listed = inquiry.list_campaigns(session, 50)
    jobs = {"queued": 1, "succeeded": 4, "waiting": 3}
    assert [c.campaign for c in listed] == [name_of(1), name_of(0)]
    assert (listed[0].jobs, listed[0].states, listed[0].views) == (jobs, 3, 2)
    assert len(found.statements) <= 4
    with catalogue.reading() as session:
        assert len(inquiry.list_campaigns(session, 1)) == 1
