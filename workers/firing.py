"""Submits what schedules have due."""

from __future__ import annotations

import logging
import threading
from datetime import UTC, datetime

from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.jobs.scheduling import firing

logger = logging.getLogger(__name__)

_EVERY_S = 1.0


class Firing(threading.Thread):
    """A thread of the supervisor: what is due is held against the archive, and a share that does not answer
    must not keep the supervisor from its beats.

    Attributes
    ----------
    looking
        Held while schedules are looked at and what is due is submitted.
    has_looked
        Whether that has been done since the start.
    """

    def __init__(self, services: Services) -> None:
        super().__init__(name="schedules", daemon=True)
        self._services = services
        self._stop_asked = threading.Event()
        self.looking = threading.Lock()
        self.has_looked = False

    def stop(self) -> None:
        """Ask the thread to end; one that waits for a share does so when it is answered."""
        self._stop_asked.set()

    def run(self) -> None:
        """Look until asked to stop; outlive a database that is away."""
        while not self._stop_asked.is_set():
            try:
                with self.looking:
                    self._look()
            except SmsError as error:
                logger.warning("%s", error)
            except Exception:
                # Without this thread no schedule would ever fire.
                logger.exception("schedules could not be looked at; trying again")
            self._stop_asked.wait(_EVERY_S)

    def _look(self) -> None:
        services = self._services
        for one in firing.fire_due(services.catalogue, services.archive, datetime.now(UTC)):
            logger.info("schedule %s, %s: %s", one.schedule, one.fire_time, one.outcome)
        self.has_looked = True
