"""Compiles kernels before jobs want them, in processes that the nursery forks before the places.

Where all are compiled, one process sees so and ends. Jobs wait for nothing but a kernel that they want and
that is just being compiled.
"""

from __future__ import annotations

import gc
import logging
import os
import threading

from sms_jobs.jobs.running import kernels
from sms_jobs.workers.place import end_with_supervisor
from sms_jobs.workers.tasks import SETTINGS

logger = logging.getLogger(__name__)

_NICE = 5
"""Jobs that need no kernels, or have theirs, go first."""


def start(lifeline: int, wishes: int) -> None:
    """Compile what is missing in processes of their own, as many as jobs may run here, and return at once.

    Parameters
    ----------
    lifeline
        A pipe that nobody writes to: it ends with the supervisor.
    wishes
        Standard input of the nursery, which is none of theirs.
    """
    if os.fork():
        return
    status = 1
    try:
        os.dup2(os.open(os.devnull, os.O_RDONLY), wishes)
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(process)d %(message)s")
        _prepare(lifeline)
        status = 0
    except BaseException:
        logger.exception("kernels are not compiled in advance")
    finally:
        # Whatever the nursery has set up is the nursery's to take down.
        os._exit(status)


def _prepare(lifeline: int) -> None:
    left_file = SETTINGS.kernels_left_file
    left_file.unlink(missing_ok=True)
    os.nice(_NICE)
    gc.disable()  # a tenth of compiling would be looking for garbage, and this process ends with it
    first = True
    for left in kernels.compile_all(kernels.listed(), SETTINGS.workers):
        if first:
            first = False
            threading.Thread(target=end_with_supervisor, args=(lifeline,), daemon=True).start()
            logger.info("compiling %d kernels, once on this machine", left)
        left_file.write_text(f"{left}\n")
    if not first:
        left_file.unlink(missing_ok=True)
        logger.info("all kernels are compiled")
