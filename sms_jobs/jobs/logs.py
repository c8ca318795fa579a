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
    """Copy what `sms_jobs` logs meanwhile into the job's own file; every attempt appends."""
    path = job_log(log_folder, job_id)
    path.parent.mkdir(parents=True, exist_ok=True)
    handler = logging.FileHandler(path, encoding="utf-8", delay=True)
    handler.setFormatter(_FORMAT)
    logger = logging.getLogger("sms_jobs")
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()
