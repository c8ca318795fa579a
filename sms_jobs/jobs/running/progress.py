"""How a job that runs tells how far it has come."""

from __future__ import annotations

import logging
import time

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import ServerUnreachable, StorageFull
from sms_jobs.jobs.running import lifecycle
from sms_jobs.jobs.running.lifecycle import Claim

_EVERY_S = 0.5

logger = logging.getLogger(__name__)


class ThrottledProgress:
    """Writes progress to the catalogue a few times a second at most, and hears from it when to stop."""

    def __init__(self, catalogue: Catalogue, held: Claim) -> None:
        self.closing = ""  # what was told when all was done, written or not
        self._catalogue = catalogue
        self._held = held
        self._next = 0.0

    def __call__(self, fraction: float, message: str = "") -> None:
        """Tell how much is done, from 0 to 1; raises as `lifecycle.report_progress` does."""
        if fraction >= 1.0:
            self.closing = message
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + _EVERY_S
        try:
            with self._catalogue.writing() as session:
                lifecycle.report_progress(session, self._held, min(max(fraction, 0.0), 1.0), message)
        except (ServerUnreachable, StorageFull) as error:
            # Hours of computing are not given up because nobody could be told of their progress.
            logger.warning("job %s: %s", self._held.job_id, error)
