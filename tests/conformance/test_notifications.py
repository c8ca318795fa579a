"""People are told once of what has happened, by however many supervisors, on both databases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import func, insert, select, update
from support.command import kill_all, service, wait_until
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import NOW, submit_pipeline
from support.people import SOMEBODY
from support.receivers import webhook

from sms_jobs.archive import Archive
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.notifications import NotificationRow, OccurrenceRow, SubscriptionRow
from sms_jobs.jobs.notifying import deliveries, notices
from sms_jobs.jobs.notifying.deliveries import Delivery
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.running import lifecycle, queues
from sms_jobs.jobs.scheduling import firing, schedules
from sms_jobs.jobs.scheduling.fire_times import parse_expression
from sms_jobs.jobs.scheduling.schedules import Order
from sms_jobs.records.job import JobState
from sms_jobs.records.shown.notifications import Address, SentView, Topic
from sms_jobs.settings import Settings
from sms_jobs.workers.archive_watch import ArchiveWatch
from sms_jobs.workers.notifier import Notifier

MINUTE = timedelta(minutes=1)
SECOND = timedelta(seconds=1)
NOWHERE = "http://127.0.0.1:9/"


def subscribe(catalogue: Catalogue, name: str, url: str = NOWHERE, since: datetime = NOW) -> None:
    with catalogue.writing() as session:
        deliveries.subscribe(session, name, Address.webhook(url), "s" * 20, list(Topic), since)


def told(catalogue: Catalogue, name: str | None = None) -> list[SentView]:
    with catalogue.reading() as session:
        return deliveries.sent(session, name, 1000)


def texts(catalogue: Catalogue) -> list[str]:
    with catalogue.reading() as session:
        return list(session.scalars(select(NotificationRow.text).order_by(NotificationRow.id)))


def running_jobs(catalogue: Catalogue, count: int) -> list[str]:
    """Enter so many jobs that run."""
    first = submit_pipeline(catalogue)[0]
    with catalogue.writing() as session:
        row = session.get_one(JobRow, first)
        values = {c.name: getattr(row, c.name) for c in JobRow.__table__.columns}
        session.execute(update(JobRow).values(state=JobState.SUCCEEDED))
        made = [values | {"id": f"{n:016x}", "state": JobState.RUNNING, "attempts": 1} for n in range(count)]
        session.execute(insert(JobRow), made)
    return [job["id"] for job in made]


def fail(
    catalogue: Catalogue, job_ids: Sequence[str], now: datetime, state: JobState = JobState.FAILED
) -> None:
    with catalogue.writing() as session:
        for job_id in job_ids:
            assert lifecycle.change(session, job_id, state, now, "no texture\nat all")


def test_a_thousand_failures_are_one_message_for_each_subscriber_and_minute(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    subscribe(catalogue, "day")
    jobs = running_jobs(catalogue, 1005)
    for number in range(0, 1000, 100):
        fail(catalogue, jobs[number : number + 100], NOW + number / 20 * SECOND)
    notices.gather(catalogue, NOW + MINUTE - SECOND)
    assert told(catalogue) == []
    notices.gather(catalogue, NOW + MINUTE)
    notices.gather(catalogue, NOW + MINUTE + SECOND)
    found = told(catalogue)
    assert {s.subscription: s.subject for s in found} == dict.fromkeys(
        ["night", "day"], "1,000 jobs of plate have failed"
    )
    assert len(found) == 2
    lines = texts(catalogue)[0].splitlines()
    assert lines[0] == "- simulate plate/S00, job 00000000: no texture at all"
    assert lines[20] == "- and 980 more"
    assert lines[-1] == "'sms job list -c plate --state failed' shows them"
    fail(catalogue, jobs[1000:], NOW + 2 * MINUTE)
    notices.gather(catalogue, NOW + 3 * MINUTE)
    assert told(catalogue, "night")[0].subject == "5 jobs of plate have failed"
    assert len(told(catalogue)) == 4


def test_supervisors_that_gather_at_once_tell_once(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    fail(catalogue, running_jobs(catalogue, 50), NOW)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: notices.gather(catalogue, NOW + MINUTE), range(4)))
    assert [s.subject for s in told(catalogue)] == ["50 jobs of plate have failed"]


def test_what_is_not_committed_is_not_told_and_what_succeeds_leaves_nothing(catalogue: Catalogue) -> None:
    first, second, third = running_jobs(catalogue, 3)
    with suppress(ZeroDivisionError), catalogue.writing() as session:
        lifecycle.change(session, first, JobState.FAILED, NOW, "")
        raise ZeroDivisionError
    fail(catalogue, [second], NOW, JobState.SUCCEEDED)
    with catalogue.reading() as session:
        assert session.scalar(select(func.count()).select_from(OccurrenceRow)) == 0
    fail(catalogue, [third], NOW)
    with catalogue.reading() as session:
        assert session.scalars(select(OccurrenceRow.topic)).all() == ["job-failed"]


@pytest.mark.parametrize(
    ("state", "subject"),
    [
        (JobState.QUARANTINED, "a job of plate is quarantined"),
        (JobState.NEEDS_OPERATOR, "a job of plate needs an operator"),
    ],
)
def test_each_state_has_its_topic(catalogue: Catalogue, state: JobState, subject: str) -> None:
    subscribe(catalogue, "night")
    (job,) = running_jobs(catalogue, 1)
    fail(catalogue, [job], NOW, JobState.LOST)
    fail(catalogue, [job], NOW, state)
    notices.gather(catalogue, NOW + MINUTE)
    assert [s.subject for s in told(catalogue)] == [subject]


def test_only_what_was_subscribed_is_told(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        deliveries.subscribe(session, "ops", Address.webhook(NOWHERE), "s", [Topic.DISK_LOW], NOW)
    fail(catalogue, running_jobs(catalogue, 1), NOW)
    notices.gather(catalogue, NOW + MINUTE)
    assert told(catalogue) == []


def test_a_queue_is_done_a_minute_after_its_last_job_and_once(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        held = lifecycle.claim(session, ["acquisition"], "w1", 1, NOW + SECOND)
        assert held is not None
    notices.tell_queue_done(catalogue, NOW + 5 * MINUTE)
    assert told(catalogue) == []  # one runs
    fail(catalogue, [held.job_id], NOW + 2 * SECOND)
    with catalogue.writing() as session:
        waiting = session.scalars(select(JobRow.id).where(JobRow.state.in_([JobState.QUEUED]))).all()
        lifecycle.change_some(session, waiting, JobState.CANCELLED, NOW + 3 * SECOND, "")
        lifecycle.skip_dependents(session, waiting, "", NOW + 3 * SECOND)
    subscribe(catalogue, "late", since=NOW + 4 * SECOND)
    notices.tell_queue_done(catalogue, NOW + 50 * SECOND)
    assert told(catalogue) == []
    for seconds in (63, 64, 70):
        notices.tell_queue_done(catalogue, NOW + seconds * SECOND)
    (one,) = told(catalogue)
    assert (one.subscription, one.subject) == ("night", "the queue is done")
    assert texts(catalogue)[0].startswith("Jobs that have ended: 1 failed, ")

    # Nothing has run since: that somebody tidies up is no news.
    with catalogue.writing() as session:
        (again,) = session.scalars(select(JobRow.id).where(JobRow.state == JobState.FAILED))
        lifecycle.change(session, again, JobState.QUEUED, NOW + 2 * MINUTE, "")
        lifecycle.change(session, again, JobState.CANCELLED, NOW + 2 * MINUTE, "")
    notices.tell_queue_done(catalogue, NOW + 4 * MINUTE)
    assert len(told(catalogue)) == 1


def test_a_schedule_that_missed_its_time_is_told(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    subscribe(catalogue, "night")
    order = Order("plate", (Request("simulate"),))
    expression = parse_expression("every 1h", "UTC")
    schedules.add(catalogue, "nightly", expression, order, NOW, missed_fire="skip")
    at = NOW + timedelta(hours=2.5)
    assert [one.outcome for one in firing.fire_due(catalogue, at)] == ["missed", "missed"]
    notices.gather(catalogue, at + MINUTE)
    assert [s.subject for s in told(catalogue)] == ["schedules of plate missed 2 times"]
    assert texts(catalogue)[0].startswith("- schedule nightly, 2026-03-01T13:00+00:00: missed\n")


def test_a_low_disk_is_told_once_a_day(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    for hours in (0, 1, 11, 12, 13):
        notices.tell_disk_low(catalogue, 512.3, NOW + timedelta(hours=hours))
    assert [s.created_at for s in told(catalogue)] == [NOW + timedelta(hours=12), NOW]
    assert texts(catalogue)[0].startswith("There are 512 MB left.")


@pytest.mark.parametrize(("least_mb", "paused", "count"), [(1.0, False, 0), (1e9, False, 1), (1.0, True, 1)])
def test_a_supervisor_sees_that_the_disk_is_low(
    deployment: Deployment, catalogue: Catalogue, archive: Archive, least_mb: float, paused: bool, count: int
) -> None:
    subscribe(catalogue, "night")
    if paused:
        with catalogue.writing() as session:
            queues.pause(session, "cpu", "the disk is full", NOW, for_room=True)
    settings = Settings(home=deployment.home, least_room_mb=least_mb)
    watch = ArchiveWatch(Services(settings, catalogue, archive, SOMEBODY), "w1")
    watch.warn()
    watch.warn()
    assert [s.topic for s in told(catalogue)] == ["disk-low"] * count


def due_now(catalogue: Catalogue, name: str, count: int) -> None:
    """Enter so many messages for a subscriber, to be sent at once."""
    with catalogue.writing() as session:
        owner = session.scalar(select(SubscriptionRow.id).where(SubscriptionRow.name == name))
        for number in range(count):
            session.add(
                NotificationRow(
                    subscription_id=owner,
                    topic="job-failed",
                    campaign="plate",
                    key=f"key {number}",
                    subject=f"subject {number}",
                    text="text",
                    created_at=datetime.now(UTC),
                    next_try_at=datetime.now(UTC),
                )
            )


def make_due(catalogue: Catalogue) -> None:
    """Let the time pass until what waits is tried again, or a claim of it has run out."""
    with catalogue.writing() as session:
        waits = NotificationRow.next_try_at.is_not(None)
        session.execute(update(NotificationRow).where(waits).values(next_try_at=datetime.now(UTC)))


@contextmanager
def notifying(deployment: Deployment, catalogue: Catalogue, archive: Archive, number: int) -> Iterator[None]:
    """Run what supervisors tell people with, so many of them."""
    services = Services(Settings(home=deployment.home), catalogue, archive, SOMEBODY)
    threads = [Notifier(services) for _ in range(number)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        for thread in threads:
            thread.stop()
        for thread in threads:
            thread.join(timeout=30)


def all_settled(catalogue: Catalogue) -> bool:
    return all(s.state != "waits" for s in told(catalogue))


def test_two_supervisors_send_each_message_once(
    deployment: Deployment, catalogue: Catalogue, archive: Archive
) -> None:
    with webhook() as server:
        subscribe(catalogue, "night", server.url)
        due_now(catalogue, "night", 30)
        with notifying(deployment, catalogue, archive, 2):
            wait_until(lambda: all_settled(catalogue), timeout=60)
        assert Counter(s.state for s in told(catalogue)) == {"sent": 30}
        assert Counter(r.told["subject"] for r in server.requests) == {f"subject {n}": 1 for n in range(30)}
        assert len({r.headers["Idempotency-Key"] for r in server.requests}) == 30


def test_a_receiver_that_fails_is_asked_again_with_the_same_id(
    deployment: Deployment, catalogue: Catalogue, archive: Archive
) -> None:
    with webhook(500, 200) as server, notifying(deployment, catalogue, archive, 1):
        subscribe(catalogue, "night", server.url)
        due_now(catalogue, "night", 1)
        wait_until(lambda: told(catalogue)[0].error)
        (view,) = told(catalogue)
        assert (view.state, view.tries, view.error) == ("waits", 1, f"{server.url} answered 500")
        assert view.next_try_at is not None
        assert 50 < (view.next_try_at - datetime.now(UTC)).total_seconds() <= 60
        make_due(catalogue)
        wait_until(lambda: all_settled(catalogue))
        (view,) = told(catalogue)
        assert (view.state, view.tries, view.error) == ("sent", 2, None)
        first, second = server.requests
        assert first.headers["Idempotency-Key"] == second.headers["Idempotency-Key"] == first.told["id"]


def test_one_that_does_not_answer_keeps_no_other_waiting(catalogue: Catalogue) -> None:
    subscribe(catalogue, "dead")
    subscribe(catalogue, "night")
    due_now(catalogue, "dead", 2)
    now = datetime.now(UTC)
    with catalogue.writing() as session:
        for _ in range(2):
            due = deliveries.next_due(session, now)
            assert due is not None
            claimed = deliveries.claim(session, *due, now)
            assert claimed is not None
            deliveries.settle(session, claimed, "no", now)
    due_now(catalogue, "night", 1)
    with catalogue.reading() as session:
        due = deliveries.next_due(session, now + timedelta(hours=1))
        assert due is not None
        row = session.get_one(NotificationRow, due[0])
    assert (row.tries, row.subject) == (0, "subject 0")


def test_pauses_grow_to_an_hour_and_after_a_day_it_is_given_up(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    due_now(catalogue, "night", 1)
    now = datetime.now(UTC)
    pauses = []
    for _ in range(100):
        with catalogue.writing() as session:
            due = deliveries.next_due(session, now)
            assert due is not None
            claimed = deliveries.claim(session, *due, now)
            assert claimed is not None
            deliveries.settle(session, claimed, "no", now)
        (view,) = told(catalogue)
        if view.next_try_at is None:
            break
        pauses.append((view.next_try_at - now).total_seconds() / 60)
        now = view.next_try_at
    assert pauses[:7] == [1, 2, 4, 8, 16, 32, 60]
    assert set(pauses[7:]) == {60}
    assert (view.state, view.error) == ("given up", "no")
    assert timedelta(hours=23) < now - view.created_at <= timedelta(hours=24)


def claimed_at(catalogue: Catalogue, now: datetime) -> Delivery | None:
    with catalogue.writing() as session:
        due = deliveries.next_due(session, now)
        return None if due is None else deliveries.claim(session, *due, now)


def test_a_claim_holds_for_some_minutes_and_a_late_sender_changes_nothing(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    due_now(catalogue, "night", 1)
    now = datetime.now(UTC)
    first = claimed_at(catalogue, now)
    assert first is not None
    assert claimed_at(catalogue, now + 4 * MINUTE) is None
    with catalogue.writing() as session:
        assert deliveries.claim(session, first.row_id, 0, now) is None  # as another that read the same
    second = claimed_at(catalogue, now + 6 * MINUTE)
    assert second is not None
    assert second.notification == first.notification
    with catalogue.writing() as session:
        deliveries.settle(session, first, "broken off", now + 7 * MINUTE)
    (view,) = told(catalogue)
    assert (view.tries, view.error) == (2, None)


def test_what_a_killed_supervisor_had_claimed_is_sent_by_the_next(deployment: Deployment) -> None:
    make_home(deployment.home, deployment.environment)
    catalogue = deployment.catalogue()
    with webhook() as server, ExitStack() as closing:
        closing.callback(catalogue.close)
        subscribe(catalogue, "night", server.url)
        due_now(catalogue, "night", 1)
        server.answering.clear()
        with service(deployment.home, deployment.environment) as supervisor:
            wait_until(lambda: server.requests)
            kill_all(supervisor)
        server.answering.set()
        (view,) = told(catalogue)
        assert (view.state, view.tries) == ("waits", 1)
        make_due(catalogue)
        with service(deployment.home, deployment.environment):
            wait_until(lambda: all_settled(catalogue))
        (view,) = told(catalogue)
        assert (view.state, view.tries) == ("sent", 2)
        first, second = server.requests
        assert (first.body, first.headers["Idempotency-Key"]) == (
            second.body,
            second.headers["Idempotency-Key"],
        )


def test_what_was_sent_long_ago_is_forgotten_and_what_waits_is_not(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    due_now(catalogue, "night", 2)
    now = datetime.now(UTC)
    claimed = claimed_at(catalogue, now)
    assert claimed is not None
    with catalogue.writing() as session:
        deliveries.settle(session, claimed, None, now)
    deliveries.forget(catalogue, now + timedelta(days=29))
    assert len(told(catalogue)) == 2
    deliveries.forget(catalogue, now + timedelta(days=31))
    assert [s.state for s in told(catalogue)] == ["waits"]


def test_who_is_removed_is_sent_nothing_more(catalogue: Catalogue) -> None:
    subscribe(catalogue, "night")
    due_now(catalogue, "night", 1)
    with catalogue.writing() as session:
        deliveries.unsubscribe(session, "night")
    assert told(catalogue) == []
    assert claimed_at(catalogue, datetime.now(UTC)) is None
