"""Lets work go on that was held back for the sake of the archive's disk or share, once that is in order.

It also says when little room is left, before work has to be held back.
"""

from __future__ import annotations

import logging
import threading
import time
from datetime import UTC, datetime

from sqlalchemy import select

from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.errors import SmsError, StorageFull, StorageUnusable
from sms_jobs.jobs.notifying import notices
from sms_jobs.jobs.running import queues, recovery
from sms_jobs.records.subject import Subject

logger = logging.getLogger(__name__)

_EVERY_S = 1.0
_WARN_EVERY_S = 60.0
_WARNED_BELOW = 4.0
"""Times the room with which no job is started."""


class ArchiveWatch(threading.Thread):
    """A thread of the supervisor: a share that does not answer must not keep it from its beats."""

    def __init__(self, services: Services, worker_id: str) -> None:
        super().__init__(name="archive-watch", daemon=True)
        self._services = services
        self._worker_id = worker_id
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        """Ask the thread to end; one that waits for a share does so when it is answered."""
        self._stop_asked.set()

    def run(self) -> None:
        """Look until asked to stop; outlive a database that is away."""
        warn_at = 0.0
        while not self._stop_asked.wait(_EVERY_S):
            try:
                self.look()
                if time.monotonic() >= warn_at:
                    warn_at = time.monotonic() + _WARN_EVERY_S
                    self.warn()
            except SmsError as error:
                logger.warning("%s", error)
            except Exception:
                # Without this thread what is held back would be so for ever.
                logger.exception("the archive could not be looked at; trying again")

    def look(self) -> None:
        """Let go on what was held back, if it may."""
        with self._services.catalogue.reading() as session:
            full = queues.are_held_for_room(session)
            held = session.execute(
                select(WorkerRow.held_at).where(
                    WorkerRow.id == self._worker_id, WorkerRow.held_for.is_not(None)
                )
            ).one_or_none()
        if not full and held is None:
            return
        archive = self._services.archive
        try:
            archive.require_usable(self._services.settings.least_room_mb)
            archive.probe(None if held is None or held.held_at is None else Subject.parse(held.held_at))
        except (StorageFull, StorageUnusable):
            return
        with self._services.catalogue.writing() as session:
            resumed = queues.resume_for_room(session)
            recovery.release(session, self._worker_id)
        going_on = [*resumed, *([] if held is None else [f"worker {self._worker_id}"])]
        logger.info("the archive is in order again: %s go on", ", ".join(going_on))

    def warn(self) -> None:
        """Tell subscribers where little room is left, or queues wait for it."""
        try:
            free_mb = self._services.archive.room().free_bytes / 1e6
        except OSError:
            return  # a share that is gone holds work back, and says so there
        if free_mb >= _WARNED_BELOW * self._services.settings.least_room_mb:
            with self._services.catalogue.reading() as session:
                if not queues.are_held_for_room(session):
                    return
        notices.tell_disk_low(self._services.catalogue, free_mb, datetime.now(UTC))
