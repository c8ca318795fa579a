"""Many processes that write to one SQLite catalogue at the same moment, and how long each held the lock.

They are forked from one that has loaded the program, so that they come together: each started by itself would
load for seconds, and they would come one after the other.
"""

from __future__ import annotations

import importlib
import json
import os
import runpy
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import event
from sqlalchemy.pool import Pool

from sms_jobs.kinds import all_kinds


@dataclass(frozen=True)
class Visit:
    """What one process did: how it ended, and the longest that it waited for the lock and held it, in s."""

    exit_code: int
    said: str
    waited_s: float
    held_s: float


class WriteTimes:
    """Listens to every SQLite connection of this process that is opened from now on, and takes its times."""

    def __init__(self) -> None:
        self.waits: list[float] = []
        self.holds: list[float] = []
        self._asked_at: float | None = None
        self._had_at: float | None = None
        event.listen(Pool, "connect", self._connected)
        event.listen(Pool, "checkin", self._returned)

    def _connected(self, connection: Any, _record: Any) -> None:
        connection.set_trace_callback(self._traced)

    def _traced(self, statement: str) -> None:
        # It is called when a statement begins: the one after a BEGIN shows that this has succeeded.
        now = time.perf_counter()
        if statement.startswith("BEGIN IMMEDIATE"):
            self._asked_at = self._asked_at or now
        elif self._asked_at is not None and self._had_at is None:
            self.waits.append(now - self._asked_at)
            self._had_at = now

    def _returned(self, _connection: Any, _record: Any) -> None:
        if self._had_at is not None:
            self.holds.append(time.perf_counter() - self._had_at)
        self._asked_at = self._had_at = None


def crowd(words: Sequence[str], count: int, folder: Path) -> list[Visit]:
    """Run one command of `sms` in so many processes at once, and return what became of each.

    Parameters
    ----------
    words
        Of the command, without `sms`.
    folder
        An empty one, for what they tell.
    """
    command = [sys.executable, "-P", "-m", "sms_jobs.bench.crowd", str(folder), str(count), *words]
    # A process that is forked must have no threads.
    alone = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with (folder / "crowd.log").open("wb") as log:
        subprocess.run(command, env=alone, stdin=subprocess.DEVNULL, stdout=log, stderr=log, check=False)
    return [_read_visit(folder / str(number)) for number in range(count)]


def _read_visit(file: Path) -> Visit:
    report, said = file.with_suffix(".json"), file.with_suffix(".txt")
    text = said.read_text(encoding="utf-8") if said.exists() else "it never began"
    facts = json.loads(report.read_text(encoding="utf-8")) if report.exists() else {}
    return Visit(facts.get("exit_code", -1), text, facts.get("waited_s", 0.0), facts.get("held_s", 0.0))


def _gather(folder: Path, count: int, words: Sequence[str]) -> None:
    """Load what the command needs, then let processes run it, all from the same moment."""
    for name in ("sms_jobs.cli.commands", f"sms_jobs.cli.{words[0]}"):
        importlib.import_module(name)
    all_kinds()
    waiting, starting = os.pipe()
    children = []
    for number in range(count):
        child = os.fork()
        if child == 0:
            os.close(starting)
            os.read(waiting, 1)  # until nobody has the other end any more
            _visit(words, folder / str(number))
        children.append(child)
    os.close(waiting)
    os.close(starting)
    for child in children:
        os.waitpid(child, 0)


def _visit(words: Sequence[str], file: Path) -> None:
    """Run a command, tell what became of it, and end this process."""
    with file.with_suffix(".txt").open("wb") as said:
        os.dup2(said.fileno(), 1)
        os.dup2(said.fileno(), 2)
    times, code = WriteTimes(), 1
    sys.argv = ["sms", *words]
    try:
        runpy.run_module("sms_jobs.cli.main", run_name="__main__")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001 - whatever it is, this process must not go on as its parent
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    longest = {"waited_s": max(times.waits, default=0.0), "held_s": max(times.holds, default=0.0)}
    file.with_suffix(".json").write_text(json.dumps({"exit_code": code, **longest}), encoding="utf-8")
    os._exit(0)


if __name__ == "__main__":
    _gather(Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3:])
