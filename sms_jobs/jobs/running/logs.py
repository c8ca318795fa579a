"""One log file a job, where every host can read it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_FORMAT = logging.Formatter("%(asctime)s %(levelname)s %(message)s")


def job_log(log_folder: Path, job_id: str) -> Path:
    """Return where a job's log lies."""
    return log_folder / "jobs" / f"{job_id}.log"


@contextmanager
def logged(log_folder: Path, job_id: str) -> Iterator[None]:
    """Copy what `sms_jobs` logs meanwhile into the job's own file; every attempt appends.

    A job whose log cannot be written is run all the same: the worker's own log has it too.
    """
    path = job_log(log_folder, job_id)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(path, encoding="utf-8")
    except OSError as error:
        logging.getLogger(__name__).warning("job %s has no log of its own: %s", job_id, error)
        yield
        return
    handler.setFormatter(_FORMAT)
    logger = logging.getLogger("sms_jobs")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
