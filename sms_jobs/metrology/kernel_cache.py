"""Numba's cache of compiled kernels, in which no kernel is compiled twice on one machine.

Numba lets every process that misses a kernel compile it, and processes that save two signatures of one kernel
at once lose one of them. Here a process that misses a kernel takes the lock of a file beside its index, looks
again, and lets go when the kernel is saved. The lock ends with the process, however that ends. A kernel is
locked after those that call it, so that nobody waits in a circle. Where nothing can be locked or written,
kernels are compiled all the same.

What was compiled holds as long as the source of the kernel and of all modules that its own imports has not
changed: Numba by itself looks at the kernel's own file, and a kernel that it calls lies in another.

The file of the lock has a line of every compilation: a digest of the source, CPU-seconds without those of
kernels that were compiled meanwhile because they are called, and the signature.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import resource
import threading
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

from sms_jobs.metrology.signatures import text_of

_LOOK_EVERY_S = 0.02
_PATIENCE_S = 600.0
_IMPORT = re.compile(r"^(?:from|import) +([\w.]+)(?: +import +(\([^)]*\)|[^\n]*))?", re.MULTILINE)


class Compilation(NamedTuple):
    """One compilation of a kernel: its signature, and the CPU-seconds that it took."""

    signature: str
    cpu_s: float


def source_digest(file: str) -> str:
    """Return a digest of the source of a module and of all that it imports of its own package, at the top."""
    folder = os.path.dirname(os.path.abspath(file))  # noqa: PTH100, PTH120
    while os.path.exists(os.path.join(os.path.dirname(folder), "__init__.py")):  # noqa: PTH110, PTH118, PTH120
        folder = os.path.dirname(folder)  # noqa: PTH120
    found: set[str] = set()
    pending = [file]
    while pending:
        module = pending.pop()
        if module not in found:
            found.add(module)
            pending += _imported(module, folder)
    return hashlib.sha256("".join(sorted(map(_digest, found))).encode()).hexdigest()[:16]


@cache
def _digest(file: str) -> str:
    return hashlib.sha256(_text(file).encode()).hexdigest()


@cache
def _imported(file: str, package: str) -> tuple[str, ...]:
    """Return the modules below a package's folder that another imports."""
    beside, own = os.path.split(package)
    named = []
    for module, members in _IMPORT.findall(_text(file)):
        if module.split(".")[0] == own:
            path = os.path.join(beside, *module.split("."))  # noqa: PTH118
            named += [path, *(os.path.join(path, word) for word in re.findall(r"\w+", members))]  # noqa: PTH118
    return tuple(f"{path}.py" for path in named if os.path.isfile(f"{path}.py"))  # noqa: PTH113


def _text(file: str) -> str:
    with open(file, encoding="utf-8") as opened:  # noqa: PTH123
        return opened.read()


class KernelCache(FunctionCache):
    """The cache of one kernel. Used by one thread at a time, since Numba compiles in one thread at a time.

    Raises `RuntimeError`, as Numba's own, where neither the package's folders nor the user's can be written.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._path = os.path.join(self.cache_path, f"{self._impl.filename_base}.lock")  # noqa: PTH118
        self._stamp = source_digest(function.__code__.co_filename)
        self._cache_file = IndexDataCacheFile(self._cache_path, self._impl.filename_base, self._stamp)
        self._descriptor = -1
        self._turns = 0

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel for a signature; None, with the turn to compile it, where nobody has done so."""
        found = super().load_overload(sig, target_context)
        if found is None:
            self.take_turn()
            found = super().load_overload(sig, target_context)
            if found is not None:
                self.give_turn()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save a kernel that was compiled, where that is possible, and give the turn away."""
        try:
            with suppress(OSError):  # it works without being saved
                # without the source and its types, to be read by people: a hundredth of compiling
                super().save_overload(sig, data._replace(type_annotation=None))
                self._note(sig)
        finally:
            self.give_turn()

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Tell whether a kernel is saved for a signature, without loading it."""
        key = self._index_key(sig, target_context.codegen())
        name = self._cache_file._load_index().get(key)
        return name is not None and os.path.exists(self._cache_file._data_path(name))  # noqa: PTH110

    def compilations(self) -> list[Compilation]:
        """Return what was compiled of the source as it is, in order."""
        try:
            with open(self._path, encoding="utf-8") as file:  # noqa: PTH123
                lines = [line.rstrip("\n").split("\t") for line in file]
        except OSError:
            return []
        return [Compilation(line[2], float(line[1])) for line in lines if line[0] == self._stamp]

    def take_turn(self, *, wait: bool = True) -> bool:
        """Keep other processes from compiling this kernel; tell whether this one may do so now.

        Who waits always may, once the others are done or, since one that was stopped shall hang nobody, after
        ten minutes. Turns of one process are counted: a kernel may call itself.
        """
        if self._turns == 0:
            with suppress(OSError):
                self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
            if not self._locked(wait):
                self._let_go()
                if not wait:
                    return False
        self._turns += 1
        return True

    def give_turn(self) -> None:
        """Let other processes compile this kernel."""
        self._turns -= 1
        if self._turns == 0:
            self._let_go()

    def _locked(self, wait: bool) -> bool:
        began = os.times().elapsed
        while True:
            try:
                # Of the process, not of the open file: a child that is forked meanwhile does not keep it.
                fcntl.lockf(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError):
                if not wait or os.times().elapsed - began > _PATIENCE_S:
                    return False
                threading.Event().wait(_LOOK_EVERY_S)
            except (OSError, ValueError):
                return True  # nothing can be locked here
            else:
                return True

    def _let_go(self) -> None:
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _note(self, sig: Any) -> None:
        if self._descriptor >= 0:
            line = f"{self._stamp}\t{_clock.last_s:.3f}\t{text_of(sig)}\n"
            os.write(self._descriptor, line.encode())


class _Clock(event.Listener):
    """Measures compilations, which lie within each other, and ends the turn of one that fails."""

    def __init__(self) -> None:
        self.last_s = 0.0
        self._began: list[float] = []
        self._within: list[float] = [0.0]

    def on_start(self, event: Any) -> None:
        if _is_kernel(event):
            self._began.append(_cpu_seconds())
            self._within.append(0.0)

    def on_end(self, event: Any) -> None:
        if not _is_kernel(event):
            return
        taken = _cpu_seconds() - self._began.pop()
        self.last_s = taken - self._within.pop()
        self._within[-1] += taken
        dispatcher = event.data["dispatcher"]
        if tuple(event.data["args"]) not in dispatcher.overloads:
            dispatcher._cache.give_turn()


def _is_kernel(event: Any) -> bool:
    return isinstance(event.data["dispatcher"]._cache, KernelCache)


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_THREAD)
    return used.ru_utime + used.ru_stime


_clock = _Clock()
event.register("numba:compile", _clock)


def cached(compiled: Any) -> Any:
    """Give a compiled function the cache; leave it without where nothing can be written."""
    if isinstance(compiled, Dispatcher):
        with suppress(RuntimeError, OSError):
            vars(compiled)["_cache"] = KernelCache(compiled.py_func)
    return compiled
