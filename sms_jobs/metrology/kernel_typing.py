"""Types of what kernels say are found where they are, before Numba looks everywhere else.

For each `a * b` of two numbers Numba asks, in turn, whether they are lists, arrays or times, and compares
their types with every type of number; for each `array[i]` it asks whether that is a text, a dictionary or a
record before it looks at arrays, if its whole library was loaded first. That took a seventh of compilation.
What is found is the same: none of the others has an answer for numbers or arrays.
"""

from __future__ import annotations

import operator
from functools import cache
from typing import Any

from numba.core.registry import cpu_target
from numba.core.typing import builtins  # noqa: F401  (declares the operators)
from numba.core.typing.templates import ConcreteTemplate, builtin_registry

from sms_jobs.metrology.signatures import types

_ARITHMETIC = ("add", "sub", "mul", "truediv", "floordiv", "mod")
_COMPARISONS = ("lt", "le", "gt", "ge")  # two constants are compared in their own way by == and !=
OPERATORS = tuple(
    getattr(operator, name)
    for name in (*_ARITHMETIC, *(f"i{name}" for name in _ARITHMETIC), *_COMPARISONS, "neg")
)
"""Operators whose types are found at once for numbers."""


@cache
def load_in_order() -> None:
    """Load what compiles kernels: rules for numbers, those for arrays, and only then all others.

    Numba asks in the order in which it has loaded them.
    """
    declare: Any = builtin_registry.register_global
    for of, function in list(builtin_registry.globals):
        if any(of is one for one in OPERATORS):
            for rule in function.templates:
                if issubclass(rule, ConcreteTemplate):
                    declare(of)(_of_numbers(rule))
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def _of_numbers(rule: Any) -> Any:
    """Return Numba's own rule of an operator, to be asked before all others, and for numbers alone."""
    known: dict[tuple[Any, ...], Any] = {}

    class OfNumbers(rule):  # type: ignore[misc]
        metadata = {"target": "cpu"}  # rules of one target are asked before those of all

        def apply(self, args: Any, kws: Any) -> Any:
            if not all(isinstance(one, types.Number) for one in args):
                return None
            pair = tuple(args)
            if pair not in known:
                known[pair] = super().apply(args, kws)
            return known[pair]

    return OfNumbers
