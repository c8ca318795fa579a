"""Tells subscribers what has happened; of several supervisors each does, and none what another has done."""

from __future__ import annotations

import logging
import threading
import time
from datetime import UTC, datetime

from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.jobs.notifying import deliveries, notices, sending

logger = logging.getLogger(__name__)

_EVERY_S = 1.0
_ASK_WHETHER_DONE_EVERY_S = 5.0
_FORGET_EVERY_S = 3600.0


class Notifier(threading.Thread):
    """A thread of the supervisor: a receiver that does not answer must not keep it from its beats."""

    def __init__(self, services: Services) -> None:
        super().__init__(name="notifier", daemon=True)
        self._services = services
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        """Ask the thread to end after what it is sending."""
        self._stop_asked.set()

    def run(self) -> None:
        """Tell until asked to stop; outlive a database that is away."""
        ask_at = forget_at = 0.0
        while not self._stop_asked.wait(_EVERY_S):
            try:
                notices.gather(self._services.catalogue, datetime.now(UTC))
                if time.monotonic() >= ask_at:
                    ask_at = time.monotonic() + _ASK_WHETHER_DONE_EVERY_S
                    notices.tell_queue_done(self._services.catalogue, datetime.now(UTC))
                if time.monotonic() >= forget_at:
                    forget_at = time.monotonic() + _FORGET_EVERY_S
                    deliveries.forget(self._services.catalogue, datetime.now(UTC))
                while not self._stop_asked.is_set() and self._send_next():
                    pass
            except SmsError as error:
                logger.warning("%s", error)
            except Exception:
                # Without this thread nobody would be told anything any more.
                logger.exception("subscribers could not be told; trying again")

    def _send_next(self) -> bool:
        """Send what is due next; False where nothing is."""
        catalogue = self._services.catalogue
        with catalogue.reading() as session:
            due = deliveries.next_due(session, datetime.now(UTC))
        if due is None:
            return False
        with catalogue.writing() as session:
            claimed = deliveries.claim(session, *due, datetime.now(UTC))
        if claimed is None:
            return True  # another supervisor was faster; there may be more
        error = None
        try:
            sending.send(self._services.settings, claimed, datetime.now(UTC))
        except SmsError as refused:
            error = str(refused)
        except Exception as unexpected:  # noqa: BLE001 - whatever it is, it is given up one day
            # Its words may repeat a secret.
            error = f"unexpected {type(unexpected).__name__}"
        if error is not None:
            logger.warning("subscription %s: %s", claimed.subscription, error)
        with catalogue.writing() as session:
            deliveries.settle(session, claimed, error, datetime.now(UTC))
        return True
