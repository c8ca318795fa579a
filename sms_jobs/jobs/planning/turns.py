"""Turns of the processes of one host that are about to plan.

Planning loads every kind: seconds of computing and a quarter of a gigabyte. Of a crowd of submissions as
many plan at the same time as there are processors; the others would only make each of them slower, and all
together need more memory than there is.
"""

from __future__ import annotations

import fcntl
import os
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PATIENCE_S = 600.0
_PAUSE_S = 0.1


@contextmanager
def planning_turn(folder: Path) -> Iterator[None]:
    """Wait for a turn, and have it until the end; files in `folder` tell who has one.

    It is a courtesy: where the files cannot be written, or nobody comes to an end, work goes on without it.
    """
    held = _taken(folder)
    try:
        yield
    finally:
        if held is not None:
            os.close(held)


def _taken(folder: Path) -> int | None:
    deadline = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline:
        for number in range(os.cpu_count() or 1):
            try:
                file = os.open(folder / f".planning-{number}.lock", os.O_RDWR | os.O_CREAT, 0o600)
            except OSError:
                return None
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(file)
            except OSError:
                os.close(file)
                return None
            else:
                return file
        time.sleep(random.uniform(0.5, 1.5) * _PAUSE_S)  # noqa: S311 - chance that keeps no secret
    return None
