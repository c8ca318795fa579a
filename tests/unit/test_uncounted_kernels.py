"""Kernels that do not count who holds which array: that they are given none, and refuse to make one."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from numba.core.errors import TypingError

import sms_jobs
from sms_jobs.metrology.compilation import kernel, uncounted_kernel

PACKAGE = Path(sms_jobs.__file__).parent
MAKERS = {"array", "copy", "empty", "empty_like", "full", "linalg", "ones", "ravel", "zeros", "zeros_like"}
SCALARS = {"None", "float", "int", "bool", "tuple", "np", "uint64"}


def given(kernel: Any) -> set[str]:
    """Return the words of what a kernel returns, as it is annotated."""
    return set(re.findall(r"\w+", kernel.py_func.__annotations__["return"]))


def called_by(kernel: Any) -> list[Any]:
    words = kernel.py_func.__code__.co_names
    found = [kernel.py_func.__globals__.get(word) for word in words]
    return [one for one in found if isinstance(one, Dispatcher)]


def below(kernel: Any) -> list[Any]:
    """Return a kernel and all that it calls, however indirectly."""
    found = [kernel]
    for one in found:
        found += [other for other in called_by(one) if other not in found]
    return found


def makes_an_array(kernel: Any) -> bool:
    return any(MAKERS & set(one.py_func.__code__.co_names) for one in below(kernel))


def test_no_kernel_that_counts_nothing_is_given_an_array_or_calls_one_that_makes_any() -> None:
    """What a kernel returns has to be counted down by its caller, or it is never freed.

    And what is compiled because such a kernel calls it is compiled without counting, too.
    """
    files = [p for p in PACKAGE.rglob("*.py") if "\n@uncounted_" in p.read_text("utf-8")]
    checked = 0
    for path in files:
        name = ".".join(["sms_jobs", *path.relative_to(PACKAGE).with_suffix("").parts])
        for one in vars(importlib.import_module(name)).values():
            if isinstance(one, Dispatcher) and one.targetoptions.get("_nrt") is False:
                for other in [one, *called_by(one)]:
                    assert given(other) <= SCALARS, (name, one.py_func.__name__, other.py_func.__name__)
                assert not makes_an_array(one), (name, one.py_func.__name__)
                checked += 1
    assert checked > 40


def test_the_test_sees_who_returns_an_array() -> None:
    assert called_by(_calls) == [_makes]
    assert makes_an_array(_calls)
    assert not given(_makes) <= SCALARS


def test_one_that_makes_an_array_is_refused() -> None:
    with pytest.raises(TypingError, match="zeros"):
        _allocates(3)


@kernel
def _makes(length: int) -> np.ndarray:
    return np.zeros(length)


@kernel
def _calls(length: int) -> float:
    return float(_makes(length)[0])


@uncounted_kernel
def _allocates(length: int) -> float:
    return float(np.zeros(length)[0])
