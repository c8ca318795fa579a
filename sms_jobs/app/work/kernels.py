"""The kernels that jobs need: which of them are compiled on this machine, and compiling the others."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.records.people import Right


@dataclass(frozen=True)
class KernelState:
    """How a kernel stands.

    Attributes
    ----------
    name
        `module:function`.
    signature
        Types of its arguments.
    ready
        Whether it is compiled, for this processor and from the source as it is.
    compile_cpu_s
        CPU-seconds that it took, without kernels that it calls; None where that is not known.
    """

    name: str
    signature: str
    ready: bool
    compile_cpu_s: float | None


def states() -> list[KernelState]:
    """Return how the kernels stand that jobs of a campaign need."""
    from sms_jobs.jobs.running import kernels  # which loads Numba and all kernels

    return [KernelState(one.name, one.signature, one.ready, one.compile_cpu_s) for one in kernels.listed()]


def compile_missing() -> Iterator[int]:
    """Compile those that are missing on all cores that this process may use.

    Yields
    ------
    How many are still missing, whenever that has changed; nothing where all are ready.
    """
    from sms_jobs.jobs.running import kernels

    return kernels.compile_all(kernels.listed(), len(os.sched_getaffinity(0)))


@use_case(Right.READ)
def kernels_left(services: Services) -> int:
    """Return how many kernels the service of this host is still compiling in advance."""
    try:
        return int(services.settings.kernels_left_file.read_text())
    except (OSError, ValueError):
        return 0
