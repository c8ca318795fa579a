"""What a benchmark prints: figures with unit and target, and how rates are measured.

Rates are per CPU-second of one thread, so that they mean the same on a busy machine and on an idle one.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Literal

import psutil

REPEATS = 5

Sense = Literal["at least", "at most"]


@dataclass(frozen=True)
class Figure:
    """One number of a group.

    Attributes
    ----------
    name
        Without the group's name, with its unit: `one_return_mpx_per_cpu_s`.
    value
        None when it was left out, which the conditions then say.
    unit
        For people.
    target, sense
        The project's own aim, or None where there is none.
    """

    name: str
    value: float | None
    unit: str
    target: float | None = None
    sense: Sense = "at least"

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without a target or a value."""
        if self.target is None or self.value is None:
            return None
        return self.value >= self.target if self.sense == "at least" else self.value <= self.target


@dataclass(frozen=True)
class Condition:
    """Under which conditions some figures of a group hold.

    Attributes
    ----------
    topic
        Beginning of their names, or what they have in common.
    text
        One or two sentences.
    """

    topic: str
    text: str


Found = Figure | Condition


@dataclass(frozen=True)
class Run:
    """How a group is to be run.

    Attributes
    ----------
    quick
        Leave out or shrink what takes long; the conditions then say so.
    say
        Tells the person how far it is.
    threads
        Threads of what is timed by the clock; rates always use one.
    folder
        An empty folder for temporary files.
    """

    quick: bool
    say: Callable[[str], None]
    threads: int
    folder: Path


@dataclass(frozen=True)
class Group:
    """A group of figures.

    Attributes
    ----------
    name, summary
        As `sms bench` shows them.
    warm_up
        Calls every kernel that the rates use, on next to no data: what it takes in a process without a
        cache of kernels is the time of compilation.
    measure
        Yields figures, and the conditions under which they hold, as they are measured.
    lacks
        Says what is missing here without which figures are left out, before anything is compiled; empty if
        nothing is.
    """

    name: str
    summary: str
    warm_up: Callable[[], None]
    measure: Callable[[Run], Iterator[Found]]
    lacks: Callable[[], str] = str


def cpu_seconds(work: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the median CPU time of `work`, in s, after one call that does not count.

    Counts the calling thread alone: `work` must not start threads.
    """
    work()
    taken = []
    for _ in range(repeats):
        started = time.thread_time()
        work()
        taken.append(time.thread_time() - started)
    return median(taken)


def processor() -> str:
    """Return the processor's name as far as the system tells it."""
    listing = Path("/proc/cpuinfo")
    if listing.is_file():
        for line in listing.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine() -> dict[str, str | int | float]:
    """Return what the figures depend on besides the program."""
    return {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "load_before": round(os.getloadavg()[0], 2),
        "system": platform.platform(),
        "python": sys.version.split()[0],
        "numpy": version("numpy"),
        "numba": version("numba"),
    }
