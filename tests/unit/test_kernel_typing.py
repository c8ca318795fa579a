"""Types of what kernels say are found at once, and are those that Numba finds by itself."""

import itertools
import subprocess
import sys
import textwrap
from contextlib import suppress

import numba
from numba.core import types
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target
from numba.core.target_extension import get_local_target
from numba.core.utils import order_by_target_specificity

from sms_jobs.metrology.kernel_typing import OPERATORS, load_in_order

_NUMBERS = [
    *(types.int8, types.uint8, types.int32, types.uint32, types.int64, types.uint64),
    *(types.float32, types.float64, types.complex64, types.complex128, types.literal(3)),
]


def _asked(operator):
    """Return the rules of an operator in the order in which Numba asks them."""
    context = cpu_target.typing_context
    rules = context._lookup_global(operator).templates
    return [one(context) for one in order_by_target_specificity(get_local_target(context), rules)]


def _found(rules, args):
    for rule in rules:
        with suppress(NumbaError):
            found = rule.apply(args, {})
            if found is not None:
                return found
    return None


def test_arithmetic_with_numbers_has_the_types_that_it_has_without():
    load_in_order()
    found = 0
    for operator in OPERATORS:
        first, *others = _asked(operator)
        assert "OfNumbers" in type(first).__mro__[1].__name__
        takes = 1 if operator.__name__ == "neg" else 2
        for args in itertools.product(_NUMBERS, repeat=takes):
            types_of = first.apply(args, {})
            assert types_of == _found(others, args), (operator, args)
            assert first.get_impl_key(types_of) is operator or types_of is None
            found += types_of is not None
    assert found > 1000


def test_what_is_no_number_is_left_to_others():
    load_in_order()
    array = types.Array(types.float64, 1, "C")
    for operator in OPERATORS:
        for args in [(array, array), (array, types.float64), (types.unicode_type,) * 2, (types.boolean,) * 2]:
            assert _asked(operator)[0].apply(args, {}) is None


def test_what_arrays_hold_is_looked_up_before_texts_are_asked():
    script = """
        import operator
        from numba.core.registry import cpu_target
        from sms_jobs.metrology.kernel_typing import load_in_order
        load_in_order()
        for one in (operator.getitem, operator.setitem):
            rules = cpu_target.typing_context._lookup_global(one).templates
            names = [rule.__mro__[1].__name__ for rule in rules]
            of_arrays = next(i for i, name in enumerate(names) if name.endswith("ItemBuffer"))
            assert "_OverloadFunctionTemplate" not in names[:of_arrays]
            assert "_OverloadFunctionTemplate" in names[of_arrays:]
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=True)


def test_a_function_computes_the_same_with_these_types():
    load_in_order()

    def computed(a, b, n):
        a += n
        return (a * b - b / n) % 7 if -a < b // n or n <= 3 else b

    compiled = numba.njit(computed)
    for args in [(1.5, 2, 3), (1, 2.5, 4), (7, 9, 2), (-3.25, 0.5, 1)]:
        assert compiled(*args) == computed(*args)
