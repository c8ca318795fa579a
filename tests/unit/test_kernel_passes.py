"""Kernels are compiled by Numba's passes, but for those that look for what no kernel says."""

import numba
import numpy as np
import pytest
from numba.core.compiler import Compiler
from numba.core.errors import TypingError

from sms_jobs.metrology.compilation import kernel
from sms_jobs.metrology.kernel_passes import NEEDLESS, KernelCompiler


def _names(compiler, asked):
    one = object.__new__(compiler)
    one.state = asked
    (pipeline,) = one.define_pipelines()
    return [step.__name__ for step, _ in pipeline.passes]


class _Seen(KernelCompiler):
    """Keeps what it is asked to compile."""

    states = []

    def define_pipelines(self):
        self.states.append(self.state)
        return super().define_pipelines()


def test_only_what_is_named_is_left_out():
    @numba.njit(pipeline_class=_Seen)
    def doubled(value: float) -> float:
        return 2.0 * value

    assert doubled(3.0) == 6.0
    whole = _names(Compiler, _Seen.states[0])
    assert set(NEEDLESS) <= set(whole)
    assert _names(KernelCompiler, _Seen.states[0]) == [name for name in whole if name not in NEEDLESS]


def test_a_kernel_that_needs_one_of_them_is_refused():
    @kernel
    def total(values: np.ndarray) -> float:
        return sum([value * value for value in values])

    with pytest.raises(TypingError, match="make_function"):
        total(np.ones(3))
