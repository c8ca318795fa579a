"""Signatures of kernels as text: which types a kernel is compiled for.

`(float64[:, ::1], readonly(uint16[:]), int64, sms_jobs.virtual_rig.rays.Specimen(float64, bool))`
is an array of two dimensions whose rows lie one after the other, one of any strides that is only read,
a number, and a named tuple.
"""

from __future__ import annotations

import ast
import importlib
from typing import Any

import numba

from sms_jobs.errors import InvalidInput

types: Any = numba.types

_LAYOUTS = {"C": ("", "::1"), "F": ("::1", ""), "A": ("", "")}
"""How the first and the last dimension of an array are written."""


def text_of(signature: tuple[Any, ...]) -> str:
    """Return the types of a kernel's arguments as text; raise `InvalidInput` for what has none."""
    return _group(signature)


def signature_of(text: str) -> tuple[Any, ...]:
    """Return the types of a kernel's arguments; raise `InvalidInput` for what is no signature."""
    try:
        whole = ast.parse(text, mode="eval").body
        if not isinstance(whole, ast.Tuple):
            raise InvalidInput(f"'{text}' is no signature of a kernel; write the list again")
        return tuple(_type_of(part) for part in whole.elts)
    except (SyntaxError, AttributeError, ImportError) as error:
        raise InvalidInput(f"'{text}' is no signature of a kernel ({error}); write the list again") from error


def _group(of: Any) -> str:
    return f"({', '.join(map(_text, of))}{',' * (len(of) == 1)})"


def _text(one: Any) -> str:
    if isinstance(one, types.Array):
        text = f"{_text(one.dtype)}[{_dimensions(one)}]"
        return text if one.mutable else f"readonly({text})"
    if isinstance(one, types.BaseNamedTuple):
        name = one.instance_class
        return f"{name.__module__}.{name.__qualname__}{_group(one.types)}"
    if isinstance(one, types.BaseTuple):
        return _group(one.types)
    if isinstance(one, types.Dispatcher):
        function = one.dispatcher.py_func
        return f"kernel({function.__module__}.{function.__qualname__})"
    if isinstance(one, types.Omitted):
        return f"omitted({one.value!r})"
    if isinstance(one, types.Literal):
        return f"literal({one.literal_value!r})"
    if isinstance(one, types.Optional):
        return f"optional({_text(one.type)})"
    if isinstance(one, types.Number | types.Boolean | types.NoneType):
        return str(one)
    raise InvalidInput(f"an argument of the type {one} has no name in the list of kernels; give it another")


def _dimensions(one: Any) -> str:
    first, last = _LAYOUTS[one.layout]
    rest = ["", *[""] * (one.ndim - 1)]
    rest[0], rest[-1] = first or rest[0], last or rest[-1]
    return ", ".join(part or ":" for part in rest)


def _type_of(node: ast.expr) -> Any:
    match node:
        case ast.Tuple(elts=parts):
            return types.BaseTuple.from_types([_type_of(part) for part in parts])
        case ast.Name(id=name):
            return getattr(types, name)
        case ast.Subscript(value=dtype, slice=ast.Tuple(elts=parts)):
            return _array(_type_of(dtype), parts)
        case ast.Subscript(value=dtype, slice=part):
            return _array(_type_of(dtype), [part])
        case ast.Call(func=ast.Name(id="readonly"), args=[part]):
            return _type_of(part).copy(readonly=True)
        case ast.Call(func=ast.Name(id="optional"), args=[part]):
            return types.Optional(_type_of(part))
        case ast.Call(func=ast.Name(id="omitted"), args=[part]):
            return types.Omitted(ast.literal_eval(part))
        case ast.Call(func=ast.Name(id="literal"), args=[part]):
            return types.literal(ast.literal_eval(part))
        case ast.Call(func=ast.Name(id="kernel"), args=[part]):
            return types.Dispatcher(_named(part))
        case ast.Call(func=name, args=parts):
            return types.BaseTuple.from_types([_type_of(part) for part in parts], _named(name))
    raise InvalidInput(f"'{ast.unparse(node)}' is no type of an argument; write the list of kernels again")


def _array(dtype: Any, parts: list[ast.expr]) -> Any:
    written = [ast.unparse(part) for part in parts]
    layout = "C" if written[-1] == "::1" else "F" if written[0] == "::1" else "A"
    return types.Array(dtype, len(parts), layout)


def _named(node: ast.expr) -> Any:
    module, _, name = ast.unparse(node).rpartition(".")
    return getattr(importlib.import_module(module), name)
