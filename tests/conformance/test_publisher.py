"""The publisher wakes processes, and lets no message lie about that would wake nobody."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

import pytest
from celery import Celery
from pydantic import SecretStr
from sqlalchemy import func, select, update
from support.command import wait_until
from support.deployments import Deployment
from support.jobs import submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.queues import OutboxRow
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.running import doorbell, queues, recovery
from sms_jobs.records.job import ALIVE_WITHIN
from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import make_app, message_queue
from sms_jobs.workers.publisher import Publisher

QUEUE = "cpu"


@pytest.fixture
def app(deployment: Deployment) -> Iterator[Celery]:
    broker = deployment.environment.get("SMS_BROKER_URL", "")
    app = make_app(Settings(home=deployment.home, broker_url=SecretStr(broker)))
    purge(app)
    yield app
    purge(app)
    app.close()


def purge(app: Celery) -> None:
    with app.connection_or_acquire() as connection:
        connection.default_channel.queue_purge(message_queue(QUEUE))


def lying_about(app: Celery) -> int:
    with app.connection_or_acquire() as connection:
        return int(connection.default_channel.queue_declare(message_queue(QUEUE)).message_count)


@contextmanager
def publishing(app: Celery, catalogue: Catalogue, capacity: int) -> Iterator[None]:
    publisher = Publisher(app, catalogue, capacity)
    publisher.start()
    try:
        yield
    finally:
        publisher.stop()
        publisher.join(timeout=30)


def many_queued(catalogue: Catalogue) -> int:
    """Submit jobs of several campaigns, all of them queued for `QUEUE`; return how many."""
    for number in range(4):
        submit_pipeline(catalogue, f"plate{number}")
    with catalogue.writing() as session:
        session.execute(update(JobRow).values(queue=QUEUE))
        session.execute(update(OutboxRow).values(queue=QUEUE))
        return session.scalar(select(func.count()).select_from(OutboxRow)) or 0


def sent(catalogue: Catalogue) -> bool:
    with catalogue.reading() as session:
        return session.scalar(select(func.count()).select_from(OutboxRow)) == 0


def test_there_are_no_more_messages_than_processes(catalogue: Catalogue, app: Celery) -> None:
    assert many_queued(catalogue) > 3
    with publishing(app, catalogue, capacity=3):
        wait_until(lambda: sent(catalogue), timeout=30)
        assert lying_about(app) == 3
        # Nobody hears, and it is rung again and again.
        time.sleep(5.0)
        assert lying_about(app) == 3
        # They are lost.
        purge(app)
        wait_until(lambda: lying_about(app) == 3, timeout=30)


def test_no_more_are_sent_than_jobs_are_queued(catalogue: Catalogue, app: Celery) -> None:
    number = many_queued(catalogue)
    with publishing(app, catalogue, capacity=100):
        wait_until(lambda: sent(catalogue), timeout=30)
        assert lying_about(app) == number
    # Paused between two publishers: what one had decided to send before the pause it still sends.
    with catalogue.writing() as session:
        queues.pause(session, QUEUE, "nobody is to be woken", datetime.now(UTC))
    purge(app)
    with publishing(app, catalogue, capacity=100):
        time.sleep(5.0)
        assert lying_about(app) == 0


def test_every_process_of_every_living_worker_is_woken(catalogue: Catalogue, app: Celery) -> None:
    with catalogue.writing() as session:
        for name, concurrency in (("w2", 2), ("w3", 3)):
            recovery.register_worker(session, name, "there", 1, [QUEUE], concurrency, datetime.now(UTC))
    assert many_queued(catalogue) > 5
    with publishing(app, catalogue, capacity=1):
        wait_until(lambda: sent(catalogue), timeout=30)
    assert lying_about(app) == 5


def test_those_count_that_live_and_serve_the_queue(catalogue: Catalogue) -> None:
    now = datetime.now(UTC)
    with catalogue.writing() as session:
        session.execute(update(WorkerRow).values(beat_at=now - 2 * ALIVE_WITHIN))
        recovery.register_worker(session, "w2", "here", 1, ["cpu", "io"], 4, now)
        recovery.register_worker(session, "w3", "there", 1, ["cpu"], 2, now)
        recovery.register_worker(session, "w4", "there", 1, ["cpu"], 8, now)
        recovery.drain(session, "w4")
    with catalogue.reading() as session:
        assert doorbell.listeners(session, now) == {"cpu": 6, "io": 4}
