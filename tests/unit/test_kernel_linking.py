"""A kernel computes the same to the last bit, whatever was compiled or loaded before it."""

import os
import subprocess
import sys
import textwrap

import numba
import numpy as np
import pytest
from numba.core.codegen import JITCPUCodegen

from sms_jobs.metrology import compilation
from sms_jobs.metrology.kernel_linking import SelfContainedLibrary

_COLUMNS = 5
_MATCHED = textwrap.dedent(
    """
    import hashlib
    from sms_jobs.bench.correlated.lone_camera import DEFORMED, correlated
    from sms_jobs.bench.correlated.truth_pairs import READ_NOISE, pairs
    from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters

    _, stretched, *_ = pairs(7)
    pair = stretched()
    found = correlated(pair.reference, pair.deformed, READ_NOISE, CorrelateParameters(), 1)
    field = found.records["correlate", DEFORMED]["displacement"]
    for numbers in (field.image_displacement, field.covariance, field.bias):
        print(hashlib.sha256(numbers.tobytes()).hexdigest())
    """
)


@numba.njit(fastmath=compilation._REORDERED)
def _moments(values, sums):
    """Too long to become a part of what calls it."""
    for i in range(_COLUMNS):
        for j in range(_COLUMNS):
            sums[i, j] = 0.0
    for row in range(values.shape[0]):
        y = row - 0.5 * values.shape[0]
        for column in range(values.shape[1]):
            x = column - 0.5 * values.shape[1]
            value = values[row, column]
            sums[0, 0] += value * value
            sums[0, 1] += value * x
            sums[0, 2] += value * y
            sums[1, 1] += value * x * x
            sums[1, 2] += value * x * y
            sums[2, 2] += value * y * y
            sums[3, 3] += value * value * x
            sums[3, 4] += value * value * y
            sums[4, 4] += value * value * x * y


@numba.njit
def _moments_of_two(first, second, sums):
    _moments(first, sums[0])
    _moments(second, sums[1])
    _moments(first[1:], sums[2])


def test_nobody_else_calls_the_copies_that_a_kernel_has_of_others():
    values = np.arange(12.0).reshape(3, 4)
    sums = np.zeros((3, _COLUMNS, _COLUMNS))
    _moments_of_two(values, values, sums)
    (compiled,) = _moments_of_two.overloads.values()
    functions = [one for one in compiled.library._final_module.functions if not one.is_declaration]
    copies = [one for one in functions if "moments" in one.name and "of_two" not in one.name]
    assert copies
    assert {one.linkage.name for one in copies} == {"internal"}
    assert not [one.name for one in functions if one.linkage.name == "linkonce_odr"]


def test_the_passes_for_single_functions_are_set_up_once_a_module(monkeypatch):
    made, modules = [], []
    passes, optimised = JITCPUCodegen._function_pass_manager, SelfContainedLibrary._optimize_functions
    monkeypatch.setattr(
        JITCPUCodegen, "_function_pass_manager", lambda self: made.append(self) or passes(self)
    )
    monkeypatch.setattr(
        SelfContainedLibrary,
        "_optimize_functions",
        lambda self, module: modules.append(len(list(module.functions))) or optimised(self, module),
    )
    numba.njit(lambda values, sums: _moments(values, sums))(np.ones((3, 4)), np.zeros((5, 5)))
    assert 0 < len(made) == len(modules) < sum(modules)


@pytest.mark.long
def test_a_process_that_compiles_finds_what_one_finds_that_loads(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    compiles, loads = (
        subprocess.run(
            [sys.executable, "-c", _MATCHED], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    )
    assert len(compiles.split()) == 3
    assert compiles == loads
