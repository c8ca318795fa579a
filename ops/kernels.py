#!/usr/bin/env python3
"""Writes sms_jobs/jobs/running/kernels.txt: kernels that the demo needs, with the types of their arguments.

They are compiled before jobs want them. After a change of what a kernel is called with:

    rm -rf /tmp/kernels && NUMBA_CACHE_DIR=/tmp/kernels .venv/bin/sms demo --out /tmp/kernels-demo
    NUMBA_CACHE_DIR=/tmp/kernels .venv/bin/python ops/kernels.py           what differs
    NUMBA_CACHE_DIR=/tmp/kernels .venv/bin/python ops/kernels.py --write   write the list

A service that compiles the list before the demo does would keep what is no longer needed: to find that out,
empty the list before.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import pkgutil
import sys
from collections.abc import Iterator

from numba.core.dispatcher import Dispatcher

import sms_jobs.metrology
import sms_jobs.virtual_rig
from sms_jobs.jobs.running.kernels import LIST
from sms_jobs.metrology.kernel_cache import KernelCache

HEAD = "# Written by ops/kernels.py, which says what it is for.\n"


def named() -> dict[str, Dispatcher]:
    """Return all kernels of the package, each under one name, in its own module where that has it."""
    names: dict[int, str] = {}
    kernels: dict[int, Dispatcher] = {}
    for package in (sms_jobs.metrology, sms_jobs.virtual_rig):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for name, one in vars(importlib.import_module(found.name)).items():
                if isinstance(one, Dispatcher) and isinstance(one._cache, KernelCache):
                    kernels[id(one)] = one
                    if id(one) not in names or one.py_func.__module__ == found.name:
                        names[id(one)] = f"{found.name}:{name}"
    return {name: kernels[number] for number, name in names.items()}


def compiled() -> Iterator[str]:
    """Give a line for every kernel that the cache holds, with the types of its arguments."""
    for name, kernel in named().items():
        for compilation in kernel._cache.compilations():
            yield f"{name} {compilation.signature}\n"


def main() -> int:
    """Compare the list with the cache, or write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the list")
    text = [HEAD, *sorted(set(compiled()))]
    if parser.parse_args().write:
        LIST.write_text("".join(text), "utf-8")
        return 0
    differences = list(difflib.unified_diff(LIST.read_text("utf-8").splitlines(True), text, "list", "cache"))
    sys.stdout.writelines(differences)
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
