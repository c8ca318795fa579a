"""Waits for plans of recordings in a service that may never have any, and loads what carries them out."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence

from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.jobs.recording import planned_recordings

logger = logging.getLogger(__name__)

_LOOK_EVERY_S = 1.0


class Planning(threading.Thread):
    """A thread of the supervisor: an instrument that does not answer must not keep it from its beats.

    The planner needs instruments, kinds and the virtual rig, which would be 100 MB of a supervisor and two
    thirds of its start: it is loaded for the first recording that is planned.

    Parameters
    ----------
    services
        Of the home.
    worker_id
        Of the supervisor, by which it holds rigs.
    served
        Returns the queues that it serves now.
    """

    def __init__(self, services: Services, worker_id: str, served: Callable[[], Sequence[str]]) -> None:
        super().__init__(name="planner", daemon=True)
        self._services = services
        self._worker_id = worker_id
        self._served = served
        self._stop_asked = threading.Event()

    def stop(self) -> None:
        """Ask the thread to let all rigs go and end."""
        self._stop_asked.set()

    def run(self) -> None:
        """Wait for a plan and carry out all there are until asked to stop; the database may be away."""
        while not self._anything_planned():
            if self._stop_asked.wait(_LOOK_EVERY_S):
                return
        from sms_jobs.workers.planner import Planner

        Planner(self._services, self._worker_id, self._served).run(self._stop_asked)

    def _anything_planned(self) -> bool:
        try:
            with self._services.catalogue.reading() as session:
                return planned_recordings.anything_open(session)
        except SmsError as error:
            logger.warning("%s", error)
        except Exception:
            # Without this thread nothing that is planned would ever be recorded.
            logger.exception("plans of recordings could not be looked for; trying again")
        return False
