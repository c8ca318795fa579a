"""How kernels are compiled, and how they are spread over threads.

Kernels release the interpreter's lock and are compiled without Numba's own threading layer: they are
called on blocks of rows from ordinary threads. That keeps them safe in forked workers, makes the number
of threads a plain argument, and makes results independent of it (every pixel is computed by the same
instructions whichever block it falls into).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher
from numba.core.registry import CPUDispatcher

from sms_jobs.metrology.kernel_cache import cached
from sms_jobs.metrology.kernel_linking import InnerCompiler, keep_copies_apart
from sms_jobs.metrology.kernel_passes import KernelCompiler

F = TypeVar("F", bound=Callable[..., object])

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,  # to be called from C, which nobody does and takes a twentieth of compilation
    "pipeline_class": KernelCompiler,
}
_REORDERED = {"reassoc", "contract"}

keep_copies_apart()


def kernel(function: F) -> F:
    """Compile `function` to machine code: cached on disk, lock released, IEEE arithmetic."""
    return cast(F, cached(numba.njit(**_OPTIONS)(function)))


def uncounted_kernel(function: F) -> F:
    """Compile `function` as `kernel` does, without counting who holds which array.

    It may neither make an array, which Numba refuses, nor call a kernel that returns one, which nobody would
    ever free (`tests/unit/test_uncounted_kernels.py` looks). Every row that is taken of an array is counted
    in and out by atomic instructions otherwise: that takes longer than what a short function does with it.
    """
    options = _OPTIONS | {"_nrt": False}
    return cast(F, cached(numba.njit(**options)(function)))


def summing_kernel(function: F) -> F:
    """Compile `function` as `kernel` does, with leave to reorder sums and to fuse multiply with add.

    For inner loops of long sums, where it is worth a factor of two; NaN and infinity keep their meaning.
    """
    return cast(F, cached(numba.njit(**_OPTIONS, fastmath=_REORDERED)(function)))


def uncounted_summing_kernel(function: F) -> F:
    """Compile `function` as `summing_kernel` does, without counting arrays: see `uncounted_kernel`."""
    options = _OPTIONS | {"_nrt": False}
    return cast(F, cached(numba.njit(**options, fastmath=_REORDERED)(function)))


class InnerKernel(CPUDispatcher):
    """A kernel that only kernels call; see `inner`."""

    def __call__(self, *arguments: Any) -> Any:
        """Compute by a kernel that calls this one, which is compiled in every process: good for tests."""
        return self._caller(*arguments)

    @cached_property
    def _caller(self) -> Any:
        called = self
        return numba.njit(lambda *arguments: called(*arguments))


def inner(compiled: F) -> F:
    """Say that only other kernels call a kernel: `@inner` above `@kernel`, or above any other kind.

    Nothing is compiled then that takes its arguments from Python, nor is it made to machine code by itself,
    which together is a fifth of compiling a kernel.
    The package's Python may not call it (`tests/unit/test_inner_kernels.py` looks).
    """
    if isinstance(compiled, Dispatcher):
        compiled.targetoptions["no_cpython_wrapper"] = True
        dispatcher = cast(Any, compiled)
        dispatcher._compiler.pipeline_class = InnerCompiler
        dispatcher.__class__ = InnerKernel
    return compiled


def inlined(function: F) -> F:
    """Put `function` into the code of the kernels that call it, of whose leave to reorder it takes part.

    Every array that a kernel is handed is counted in and out by atomic instructions, bundles of arrays one by
    one: that costs more than a short function does.
    """
    return cast(F, numba.njit(inline="always")(function))


@inlined
def variable(number: int) -> int:
    """Return a whole number as a variable.

    A constant has a type of its own, for which Numba compiles all that is called with it.
    """
    return int(np.int64(number))


def in_row_blocks(work: Callable[[int, int], None], rows: int, threads: int, block: int = 64) -> None:
    """Call `work(start, stop)` for blocks of rows that cover `0 .. rows`, on `threads` threads.

    Parameters
    ----------
    work
        Fills its own rows of arrays that it closes over; must not depend on the other rows' results.
    rows
        Number of rows.
    threads
        Number of threads, at least 1.
    block
        Rows in a block.
    """
    blocks = [(start, min(start + block, rows)) for start in range(0, rows, block)]
    if threads == 1:
        for start, stop in blocks:
            work(start, stop)
        return
    with ThreadPoolExecutor(threads) as pool:
        for finished in [pool.submit(work, start, stop) for start, stop in blocks]:
            finished.result()
