"""Sends the messages that the catalogue says are due; the only sender there is.

A message wakes a process, which then runs all that is queued. More of them than there are processes would
wake nobody, lie about while those work, and be read one after the other when nothing is left to do.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from datetime import UTC, datetime

from celery import Celery

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.running import doorbell
from sms_jobs.jobs.running.doorbell import Call
from sms_jobs.workers.celery_app import RUN, message_queue

logger = logging.getLogger(__name__)

_EVERY_S = 0.1
_RING_AGAIN_EVERY_S = 2.0
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
        if due:
            self._ring(doorbell.calls(due))
            with self._catalogue.writing() as session:
                doorbell.sent(session, due)

    def _ring_again(self) -> None:
        with self._catalogue.reading() as session:
            calls = doorbell.unheard(session)
        self._ring(calls, again=True)

    def _ring(self, calls: Sequence[Call], *, again: bool = False) -> None:
        """Send messages as far as there are processes for them; again, as far as none lie about already."""
        with self._catalogue.reading() as session:
            listeners = doorbell.listeners(session, datetime.now(UTC))
        for call in calls:
            # A worker that is about to start is not counted yet.
            processes, waiting = max(listeners[call.queue], self._capacity), self._waiting(call.queue)
            for _ in range(min(call.number - waiting if again else call.number, processes - waiting)):
                self._send(call)

    def _waiting(self, queue: str) -> int:
        """Return how many messages lie in a queue."""
        with self._app.connection_or_acquire() as connection:
            return int(connection.default_channel.queue_declare(message_queue(queue)).message_count)

    def _send(self, call: Call) -> None:
        self._app.send_task(
            RUN, args=[call.job_id], queue=message_queue(call.queue), ignore_result=True, retry=False
        )
