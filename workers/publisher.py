"""Sends the messages that the catalogue says are due; the only sender there is."""

from __future__ import annotations

import logging
import threading
import time
from datetime import UTC, datetime, timedelta

from celery import Celery

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs import doorbell
from sms_jobs.workers.celery_app import RUN, message_queue

logger = logging.getLogger(__name__)

_EVERY_S = 0.1
_RING_AGAIN_EVERY_S = 1.0
_PATIENCE = timedelta(seconds=5)
_AFTER_FAULT_S = 2.0


class Publisher(threading.Thread):
    """A thread of the supervisor: a broker that hangs must not keep it from renewing leases."""

    def __init__(self, app: Celery, catalogue: Catalogue, capacity: int) -> None:
        super().__init__(name="publisher", daemon=True)
        self._app = app
        self._catalogue = catalogue
        self._capacity = capacity
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        """Ask the thread to end after what it is sending."""
        self._stop_asked.set()

    def run(self) -> None:
        """Send until asked to stop; outlive a broker or database that is away."""
        ring_again_at = 0.0
        while not self._stop_asked.wait(_EVERY_S):
            try:
                self._send_due()
                if time.monotonic() >= ring_again_at:
                    ring_again_at = time.monotonic() + _RING_AGAIN_EVERY_S
                    self._ring_again()
            except Exception as error:  # noqa: BLE001 - without this thread no job would begin any more
                logger.warning("messages cannot be sent now (%s); trying again", type(error).__name__)
                self._stop_asked.wait(_AFTER_FAULT_S)

    def _send_due(self) -> None:
        with self._catalogue.reading() as session:
            due = doorbell.unsent(session)
        if not due:
            return
        for _, job_id, queue in due:
            self._send(job_id, queue)
        with self._catalogue.writing() as session:
            doorbell.sent(session, due, datetime.now(UTC))

    def _ring_again(self) -> None:
        now = datetime.now(UTC)
        with self._catalogue.reading() as session:
            overdue = doorbell.overdue(session, now, _PATIENCE, self._capacity)
        for job_id, queue in overdue:
            self._send(job_id, queue)
        if overdue:
            with self._catalogue.writing() as session:
                doorbell.rung(session, [job_id for job_id, _ in overdue], now)

    def _send(self, job_id: str, queue: str) -> None:
        self._app.send_task(RUN, args=[job_id], queue=message_queue(queue), ignore_result=True, retry=False)
