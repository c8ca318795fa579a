"""The processes that run jobs, as their supervisor sees them: one a place, and the nursery that forks them.

A place that has died is filled again; one that was stopped is woken; one that neither listens nor runs a job
is killed. Whether it is well says its own sign of life, and nothing that a broker or a thread beside it says.
A thread sees to that: what was stopped may hold the very lock of the catalogue that its supervisor waits for.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path

import psutil

from sms_jobs.jobs.running.limits import Force
from sms_jobs.jobs.running.stillness import Stillness
from sms_jobs.workers.board import NURSERY, Board, new_board, place_line

logger = logging.getLogger(__name__)

_TICK_S = 0.2
_LONGEST_STEP_S = 1.0
_WAKE_AFTER_S = 3.0
"""A stopped process is woken after this; a debugger would have to be quicker."""
_STOPPED_S = 15.0
"""And killed after this, when waking does not help."""
_SILENT_S = 20.0
_SILENT_AT_THE_END_S = 8.0
"""A place that runs no job beats every two seconds, and the nursery every second."""
_IDLE_S = 60.0
"""A nursery that loads kinds uses the processor."""
_ASK_AGAIN_S = 2.0
_DEATH_S = 2.0
"""A process that is killed ends at once, unless a disk holds it."""


class Places:
    """A supervisor's places.

    Parameters
    ----------
    number
        How many.
    environment
        Of the nursery, and so of all places.
    log
        File to which they write.
    """

    def __init__(self, number: int, environment: Mapping[str, str], log: Path) -> None:
        self._lines = [NURSERY, *(place_line(n) for n in range(number))]
        self._environment = dict(environment)
        self._log = log
        self._descriptor = new_board(number)
        self._board = Board(self._descriptor)
        self._lifeline, self._lifeline_held = os.pipe()
        self._nursery: subprocess.Popen[bytes] | None = None
        self._processes: dict[int, psutil.Process] = {}
        self._asked_at: dict[int, float] = {}
        self._stopped: Stillness[int] = Stillness(_LONGEST_STEP_S)
        self._silent: Stillness[int] = Stillness(_LONGEST_STEP_S)
        self._idle: Stillness[int] = Stillness(_LONGEST_STEP_S)
        self._busy: frozenset[int] | None = None
        self._draining = False
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._tend, name="places", daemon=True)

    def start(self) -> None:
        """Fill the places, and look after them from now on."""
        self._thread.start()

    def busy(self, pids: Collection[int] | None) -> None:
        """Hear which processes run a job; None when that is not known, and then nobody is said to hang."""
        self._busy = None if pids is None else frozenset(pids)

    def living(self) -> set[int]:
        """Return the processes that are in the places now."""
        with self._lock:
            self._look()
            return {p.pid for line, p in self._processes.items() if line != NURSERY and _lives(p)}

    def end(self, pid: int, force: Force) -> None:
        """End the process of a place; one that is in none any more is left alone."""
        with self._lock:
            for line, process in self._processes.items():
                if line != NURSERY and process.pid == pid:
                    _send(process, signal.SIGKILL if force is Force.KILL else signal.SIGTERM)

    def drain(self) -> None:
        """Let each place end after what it runs, and fill none any more."""
        with self._lock:
            self._draining = True
            self._board.drain()

    def close(self) -> None:
        """Kill what is left, and let go of everything."""
        self.drain()
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join()
        self._look()
        for process in self._processes.values():
            _send(process, signal.SIGKILL)
        psutil.wait_procs(self._processes.values(), timeout=_DEATH_S)
        self._processes.clear()
        self._lines = []
        if self._nursery is not None:
            self._end_nursery(self._nursery)
            self._nursery = None
        # What was forked a moment ago and is not known yet ends by this.
        for descriptor in (self._lifeline_held, self._lifeline, self._descriptor):
            os.close(descriptor)

    def _tend(self) -> None:
        while not self._closed.wait(_TICK_S):
            try:
                with self._lock:
                    self._look()
                    self._wake_stopped(time.monotonic())
                    self._end_silent(time.monotonic())
                    if not self._draining:
                        self._fill(time.monotonic())
            except Exception:
                # Whatever it is, places would stay empty without this thread.
                logger.exception("the places cannot be looked after now; trying again")

    def _look(self) -> None:
        """Take hold of who is in which place, and let go of who is gone."""
        for line in self._lines:
            pid, _ = self._board.read(line)
            process = self._processes.get(line)
            if process is not None and process.pid == pid and _lives(process):
                continue
            if process is not None:
                del self._processes[line]
                if not self._draining:
                    logger.warning("process %d is gone", process.pid)
            if process is not None and process.pid == pid:
                self._board.clear(line)
            elif pid:
                with suppress(psutil.NoSuchProcess):
                    self._processes[line] = psutil.Process(pid)

    def _wake_stopped(self, now: float) -> None:
        there = self._all_there()
        stopped = {line: p.pid for line, p in there.items() if _is_stopped(p)}
        for line, for_s in self._stopped.look(stopped, now).items():
            process = there[line]
            if for_s > _STOPPED_S:
                logger.error("process %d was stopped and does not go on; killing it", process.pid)
                _send(process, signal.SIGKILL)
            elif for_s > _WAKE_AFTER_S:
                logger.warning("process %d was stopped; letting it go on", process.pid)
                _send(process, signal.SIGCONT)

    def _all_there(self) -> dict[int, psutil.Process]:
        """Return the processes by their lines, a nursery that still loads kinds among them."""
        if NURSERY not in self._processes and self._nursery is not None and self._nursery.poll() is None:
            return self._processes | {NURSERY: psutil.Process(self._nursery.pid)}
        return self._processes

    def _end_silent(self, now: float) -> None:
        busy = self._busy
        signs = {
            line: self._board.read(line)
            for line, process in self._processes.items()
            if busy is not None and process.pid not in busy
        }
        limit_s = _SILENT_AT_THE_END_S if self._draining else _SILENT_S
        for line, for_s in self._silent.look(signs, now).items():
            if for_s > limit_s:
                process = self._processes[line]
                logger.error("process %d gives no sign of life; killing it", process.pid)
                _send(process, signal.SIGKILL)

    def _fill(self, now: float) -> None:
        nursery = self._nursery
        if nursery is None or nursery.poll() is not None:
            self._start_nursery(now)
            return
        if NURSERY not in self._processes:
            # On a machine that is busy enough, loading takes as long as it takes.
            work = {nursery.pid: _processor_s(nursery.pid)}
            if self._idle.look(work, now)[nursery.pid] > _IDLE_S:
                logger.error("process %d has stopped loading kinds; starting another", nursery.pid)
                nursery.kill()
            return
        for number, line in enumerate(self._lines[1:]):
            if line not in self._processes and now - self._asked_at.get(line, -_ASK_AGAIN_S) >= _ASK_AGAIN_S:
                self._asked_at[line] = now
                self._ask(nursery, number)

    def _start_nursery(self, now: float) -> None:
        if self._nursery is not None:
            if now - self._asked_at[NURSERY] < _ASK_AGAIN_S:
                return
            logger.error("the nursery ended with code %d; starting another", self._nursery.returncode)
            self._end_nursery(self._nursery)
        self._board.clear(NURSERY)
        self._log.parent.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-P", "-m", "sms_jobs.workers.nursery"]
        command += [str(self._descriptor), str(self._lifeline)]
        with self._log.open("ab") as output:
            # A group of its own: Ctrl-C reaches the supervisor alone, which then ends the places in order.
            self._nursery = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                pass_fds=(self._descriptor, self._lifeline),
                process_group=0,
            )
        self._asked_at = {NURSERY: now}

    @staticmethod
    def _ask(nursery: subprocess.Popen[bytes], number: int) -> None:
        assert nursery.stdin is not None
        with suppress(BrokenPipeError):
            os.write(nursery.stdin.fileno(), bytes([number]))

    @staticmethod
    def _end_nursery(nursery: subprocess.Popen[bytes]) -> None:
        assert nursery.stdin is not None
        nursery.stdin.close()
        nursery.kill()
        nursery.wait()


def _lives(process: psutil.Process) -> bool:
    """Tell whether a process has not ended; one that nobody has buried yet has."""
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _is_stopped(process: psutil.Process) -> bool:
    try:
        return bool(process.status() == psutil.STATUS_STOPPED)
    except psutil.NoSuchProcess:
        return False


def _processor_s(pid: int) -> float:
    try:
        used = psutil.Process(pid).cpu_times()
    except psutil.NoSuchProcess:
        return 0.0
    return float(used.user + used.system)


def _send(process: psutil.Process, number: signal.Signals) -> None:
    with suppress(psutil.NoSuchProcess):
        process.send_signal(number)
