"""Kernels that only kernels call have no code for calls from Python: that none is called so."""

import ast
import importlib
import subprocess
import sys
import textwrap
from pathlib import Path

import numba
import numpy as np
from numba.core.caching import NullCache

import sms_jobs
from sms_jobs.metrology.compilation import InnerKernel, inner, kernel, uncounted_kernel

PACKAGE = Path(sms_jobs.__file__).parent
COMPUTING = ("sms_jobs.metrology", "sms_jobs.virtual_rig")
_KERNELS = textwrap.dedent(
    """
    from sms_jobs.metrology.compilation import inner, kernel

    @inner
    @kernel
    def squared(x):
        if x > 99.0:
            raise ValueError("too large", x)
        return x * x

    @kernel
    def twice(x):
        return 2.0 * squared(x)

    @kernel
    def other(x):
        return squared(x) + squared(x)
    """
)


def used_by_python(tree, known):
    """Return which inner kernels, among what a module knows by name, are used outside of kernels."""
    found = set()
    for node in outside_of_kernels(tree):
        one = None
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            one = known.get(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            one = getattr(known.get(node.value.id), node.attr, None)
        if isinstance(one, InnerKernel):
            found.add(one.py_func.__qualname__)
    return found


def outside_of_kernels(node):
    for child in ast.iter_child_nodes(node):
        decorators = [ast.unparse(one) for one in getattr(child, "decorator_list", [])]
        if not any(one.endswith("kernel") or one == "inlined" for one in decorators):
            yield child
            yield from outside_of_kernels(child)


def known_in(path, tree):
    """Return what a module knows by name of kernels, its own and those that it imports anywhere."""
    known = {}
    if any(isinstance(node, ast.Name) and node.id == "inner" for node in ast.walk(tree)):
        name = ".".join(["sms_jobs", *path.relative_to(PACKAGE).with_suffix("").parts])
        known |= vars(importlib.import_module(name))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(COMPUTING):
            for one in node.names:
                known[one.asname or one.name] = value_of(node.module, one.name)
    return known


def value_of(module, name):
    found = getattr(importlib.import_module(module), name, None)
    return importlib.import_module(f"{module}.{name}") if found is None else found


def test_no_inner_kernel_is_used_by_the_packages_python():
    kernels = set()
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text("utf-8"))
        known = known_in(path, tree)
        kernels |= {id(one) for one in known.values() if isinstance(one, InnerKernel)}
        assert not used_by_python(tree, known), path
    assert len(kernels) > 150


def test_the_test_sees_who_is_used_and_where():
    known = {"_squared": _squared, "_twice": _twice, "here": sys.modules[__name__]}
    for text in ("def f(x): return _squared(x)", "y = here._squared(3.0)", "f = [_squared]"):
        assert used_by_python(ast.parse(text), known) == {"_squared"}
    for text in ("@kernel\ndef f(x): return _squared(x)", "y = _twice(3.0)", "_squared = 2.0"):
        assert not used_by_python(ast.parse(text), known)


def test_an_inner_kernel_computes_where_a_test_calls_it():
    assert _twice(3.0) == 18.0
    assert [_squared(3.0), _squared(3.0), _squared(4)] == [9.0, 9.0, 16]
    values = np.arange(3.0)
    _double(values)
    assert values.tolist() == [0.0, 2.0, 4.0]


def test_an_inner_kernel_has_no_machine_code_of_its_own(monkeypatch):
    for one, has in ((_squared, False), (_twice, True)):
        monkeypatch.setitem(vars(one), "_cache", NullCache())  # what is loaded has no names
        one.compile((numba.float32,))
        compiled = one.overloads[(numba.float32,)]
        names = [function.name for function in compiled.library.get_defined_functions()]
        assert any("cpython" in name for name in names) == bool(names) == has, names


def test_one_that_another_process_compiled_is_linked(tmp_path):
    (tmp_path / "kernels_within.py").write_text(_KERNELS)
    for ask in ("other(3.0)", "twice(3.0)", "squared(3.0) * 2.0"):
        script = f"from kernels_within import *; assert {ask} == 18.0; print(squared._cache_hits.total())"
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        assert done.stdout == ("0\n" if ask.startswith("other") else "1\n")


def test_one_that_refuses_a_number_names_it_to_whoever_calls_its_caller(tmp_path):
    (tmp_path / "kernels_within.py").write_text(_KERNELS)
    for loaded in (0, 1):
        script = textwrap.dedent(
            """
            from kernels_within import *
            try:
                twice(100.0)
            except ValueError as error:
                print(*error.args, twice._cache_hits.total())
            """
        )
        done = subprocess.run(
            [sys.executable, "-c", script], cwd=tmp_path, check=True, capture_output=True, text=True
        )
        assert done.stdout == f"too large 100.0 {loaded}\n"


@inner
@kernel
def _squared(x):
    return x * x


@kernel
def _twice(x):
    return 2.0 * _squared(x)


@inner
@uncounted_kernel
def _double(values):
    for i in range(len(values)):
        values[i] *= 2.0
