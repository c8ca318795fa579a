"""Kernels are compiled before jobs want them: those of `kernels.txt`, on all cores, callees first.

`ops/kernels.py` writes the list from what a cache of kernels holds after a demo.
"""

from __future__ import annotations

import importlib
import logging
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from numba.core.dispatcher import Dispatcher
from numba.core.errors import NumbaError

from sms_jobs.errors import SmsError
from sms_jobs.metrology.kernel_cache import KernelCache
from sms_jobs.metrology.kernel_typing import load_in_order
from sms_jobs.metrology.signatures import signature_of

logger = logging.getLogger(__name__)

LIST = Path(__file__).with_name("kernels.txt")
_LOOK_EVERY_S = 0.1


@dataclass(frozen=True)
class Kernel:
    """A kernel for arguments of certain types.

    Attributes
    ----------
    name
        `module:function`.
    signature
        Types of its arguments, as `sms_jobs.metrology.signatures` writes them.
    """

    name: str
    signature: str

    @cached_property
    def dispatcher(self) -> Any:
        """The function that Numba compiles; raises `SmsError` where there is none of that name."""
        module, _, function = self.name.partition(":")
        found = getattr(importlib.import_module(module), function, None)
        if not isinstance(found, Dispatcher):
            raise SmsError(
                f"there is no kernel '{self.name}', which {LIST.name} names; write the list again by "
                "'python ops/kernels.py'"
            )
        return found

    @cached_property
    def types(self) -> tuple[Any, ...]:
        """The types of its arguments, as Numba knows them."""
        return signature_of(self.signature)

    @property
    def can_be_saved(self) -> bool:
        """Whether there is a folder for it: without one, each process compiles what it needs."""
        return isinstance(self.dispatcher._cache, KernelCache)

    @property
    def ready(self) -> bool:
        """Whether it is compiled, for this processor and from the source as it is."""
        dispatcher = self.dispatcher
        return self.can_be_saved and dispatcher._cache.holds(self.types, dispatcher.targetctx)

    @property
    def compile_cpu_s(self) -> float | None:
        """CPU-seconds that it last took to compile it, without kernels that it calls; None if nobody has."""
        taken = [
            one.cpu_s for one in self.dispatcher._cache.compilations() if one.signature == self.signature
        ]
        return taken[-1] if taken else None


def listed() -> tuple[Kernel, ...]:
    """Return the kernels that jobs of a campaign need."""
    lines = LIST.read_text("utf-8").splitlines()
    return tuple(Kernel(*line.split(" ", 1)) for line in lines if line and not line.startswith("#"))


def missing(kernels: Sequence[Kernel]) -> list[Kernel]:
    """Return those that are not compiled yet and could be saved."""
    return [one for one in kernels if one.can_be_saved and not one.ready]


def compile_all(kernels: Sequence[Kernel], processes: int) -> Iterator[int]:
    """Compile what is missing, this process and others that it forks beside each other.

    A kernel is started once the kernels it calls are compiled. One that cannot be compiled is left to the job
    that needs it, which says why. Must be started where there are no threads.

    Yields
    ------
    How many are still missing, whenever that has changed.
    """
    left = missing(kernels)
    if left:
        load_in_order()  # once, not in each process
    helpers = [_forked(left) for _ in range(min(processes, len(left)) - 1)]
    yield from _compiled(left)
    for helper in helpers:
        os.waitpid(helper, 0)


def _forked(kernels: Sequence[Kernel]) -> int:
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            for _ in _compiled(kernels):
                if os.getppid() != parent:
                    break
            status = 0
        finally:
            os._exit(status)
    return child


def _compiled(kernels: Sequence[Kernel]) -> Iterator[int]:
    left, waits_for = list(kernels), _callees(kernels)
    while left:
        yield len(left)
        names = {one.name for one in left}
        free = (one for one in left if not names & waits_for[one.name])
        begun = next((one for one in free if one.dispatcher._cache.take_turn(wait=False)), None)
        if begun is None:
            time.sleep(_LOOK_EVERY_S)
        else:
            _compile(begun)
            left.remove(begun)


def _compile(kernel: Kernel) -> None:
    """Compile a kernel whose turn this process has, unless somebody has done so."""
    try:
        if not kernel.ready:
            kernel.dispatcher.compile(kernel.types)
    except (NumbaError, TypeError) as error:  # the latter where the list is of another time
        logger.warning("kernel %s %s cannot be compiled: %s", kernel.name, kernel.signature, error)
    finally:
        kernel.dispatcher._cache.give_turn()


def _callees(kernels: Sequence[Kernel]) -> dict[str, frozenset[str]]:
    """Return which of the kernels each one calls, however indirectly, by name."""
    known = {id(one.dispatcher): one.name for one in kernels}
    return {
        one.name: frozenset(known[id(d)] for d in _called(one.dispatcher.py_func) if id(d) in known)
        - {one.name}
        for one in kernels
    }


def _called(function: Any, seen: set[int] | None = None) -> Iterator[Any]:
    """Give the compiled functions that a function names, and those that these name."""
    seen = set() if seen is None else seen
    for name in function.__code__.co_names:
        one = function.__globals__.get(name)
        if isinstance(one, Dispatcher) and id(one) not in seen:
            seen.add(id(one))
            yield one
            yield from _called(one.py_func, seen)
