"""Kernels are compiled without the passes of Numba that look for what no kernel says.

Numba goes through every function once more for each thing that a function might contain: others within it,
blocks with `with`, loops over tuples of several types. Kernels have none of these: one that had would be
refused as it is compiled. Machine code is the same to the byte.
"""

from __future__ import annotations

from typing import Any

from numba.core import compiler

NEEDLESS = (
    "FindLiterallyCalls",
    "InlineClosureLikes",
    "InlineOverloads",
    "LiteralPropagationSubPipelinePass",
    "LiteralUnroll",
    "MakeFunctionToJitFunction",
    "WithLifting",
)
"""Passes that are left out, by the names of their classes."""


_numba: Any = compiler  # which declares no types


class KernelCompiler(compiler.Compiler):
    """Compiles a kernel."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's passes but for those that are left out."""
        whole = _numba.DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes = _numba.PassManager(whole.pipeline_name)
        for one, says in whole.passes:
            if one.__name__ not in NEEDLESS:
                passes.add_pass(one, says)
        passes.finalize()
        return [passes]
