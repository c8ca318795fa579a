"""What a process that holds a job does while the catalogue cannot be written to: it waits.

A job that has been computed is worth more than a process that ends: the end of the job is recorded as soon as
somebody hears it, and what was claimed without being heard is given back.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from sqlalchemy.orm import Session

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import CommitInDoubt, ServerUnreachable, StorageFull

T = TypeVar("T")

_FIRST_WAIT_S = 0.1
_LONGEST_WAIT_S = 2.0
_SAY_EVERY_S = 60.0

logger = logging.getLogger(__name__)


def outlast(
    catalogue: Catalogue,
    step: Callable[[Session], T],
    settle: Callable[[Session], object],
    *,
    in_doubt: bool = False,
) -> T:
    """Do a step in one transaction, again and again until the catalogue takes it; return its result.

    Parameters
    ----------
    step
        Must find out itself whether an earlier try was committed after all.
    settle
        Done before the step when an earlier commit is in doubt.
    in_doubt
        That one is already.
    """
    wait_s, say_at = _FIRST_WAIT_S, time.monotonic()
    while True:
        try:
            with catalogue.writing() as session:
                if in_doubt:
                    settle(session)
                return step(session)
        except (ServerUnreachable, StorageFull) as error:
            in_doubt = in_doubt or isinstance(error, CommitInDoubt)
            if time.monotonic() >= say_at:
                say_at = time.monotonic() + _SAY_EVERY_S
                logger.warning("%s; waiting for it", error)
        time.sleep(wait_s)
        wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
