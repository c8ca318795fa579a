"""A compiled kernel runs its own copies of the kernels it calls, whatever else a process has loaded.

Numba links every kernel that another calls into that one, and optimises the copy once more with it. The names
of copies are weak: all call the one that was loaded first in a process. Where sums may be reordered, copies
differ in the last digits; so would results, by what the process had compiled or computed before.

What only other kernels call is therefore never run by itself, and no machine code is made of it.
"""

from __future__ import annotations

from typing import Any, cast

from numba.core import codegen
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import Compiler

from sms_jobs.metrology.kernel_passes import KernelCompiler

_ENVIRONMENT = "_ZN08NumbaEnv"


class SelfContainedLibrary(JITCodeLibrary):
    """The machine code of a kernel, in which nobody else knows the names of the copies.

    Attributes
    ----------
    only_linked
        Other kernels link it, and nobody calls it.
    """

    only_linked = False

    def _optimize_functions(self, ll_module: Any) -> None:
        """Optimise each function by itself, by passes that are set up once, where Numba does so for each.

        Names of functions that are elsewhere, which are most of a module, have nothing to be optimised.
        """
        ll_module.data_layout = self._codegen._data_layout
        passes, builder = self._codegen._function_pass_manager()
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def _finalize_final_module(self) -> None:
        if self._shared_module is None:
            # What other kernels link keeps its names, so that what comes in twice comes in once.
            self._finalized = True
            self._get_module_for_linking()
            self._finalized = False
        if self.only_linked:
            self._finalize_dynamic_globals()
            self._final_module = _environments_of(self._final_module)
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._finalize_final_module()


def _environments_of(module: Any) -> Any:
    """Return a module with no function, but with what Numba sets by name once one is compiled or loaded."""
    names = [one.name for one in module.global_variables if one.name.startswith(_ENVIRONMENT)]
    lines = [f'@"{name}" = common global ptr null' for name in names]
    text = "\n".join([f'target triple = "{module.triple}"', *lines])
    return cast(Any, codegen).ll.parse_assembly(text)


class InnerCompiler(KernelCompiler, Compiler):
    """Compiles what only other kernels call."""

    def _compile_core(self) -> Any:
        library = self.state.targetctx.codegen().create_library(self.state.func_id.func_qualname)
        library.enable_object_caching()
        library.only_linked = True
        self.state.library = library
        return super()._compile_core()


def keep_copies_apart() -> None:
    """Have kernels compiled so in this process from now on."""
    cast(Any, JITCPUCodegen)._library_class = SelfContainedLibrary
