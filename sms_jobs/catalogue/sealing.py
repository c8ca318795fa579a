"""Puts the events of jobs into the chain of the audit, some time after they were written."""

from __future__ import annotations

from datetime import datetime

from sms_jobs.catalogue import audit
from sms_jobs.catalogue.database import Catalogue


def seal(catalogue: Catalogue, now: datetime) -> int:
    """Seal all events of jobs that no link of the chain holds yet, and return how many.

    Where there are none, nothing is written. Others write between two parts of many.
    """
    with catalogue.reading() as session:
        left = audit.unsealed(session)
    count = 0
    while left:
        with catalogue.writing() as session:
            sealed = audit.seal_events(session, now)
        left, count = sealed > 0, count + sealed
    return count
