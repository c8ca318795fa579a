"""How a record is taken apart into arrays and JSON, and put together again.

The declaration of the record says it all: fields declared with `records.quantity.array` are arrays, every
other field is plain data that pydantic writes as JSON and validates strictly when it is read. Nothing is
unpickled and no name out of a file is looked up outside `sms_jobs.records`.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from typing import Any, NotRequired, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError
from typing_extensions import TypedDict

import sms_jobs.records
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.records.measurement import FrameStack
from sms_jobs.records.quantity import Quantity, quantities

R = TypeVar("R")


@dataclass(frozen=True)
class ArrayField:
    """One array field of a record.

    Attributes
    ----------
    quantity
        As declared.
    dtype
        The element type of the annotation; None where it leaves that open.
    streamed
        True for frame stacks, which are never held in memory as a whole.
    optional
        True when the field has a default, so that files without it can be read.
    """

    quantity: Quantity
    dtype: np.dtype[Any] | None
    streamed: bool
    optional: bool


@dataclass(frozen=True)
class RecordLayout:
    """What of a record class becomes arrays, and what checks and writes the rest."""

    record: type
    arrays: Mapping[str, ArrayField]
    plain_names: tuple[str, ...]
    plain: TypeAdapter[Any]


def _dtype_of(hint: Any) -> np.dtype[Any] | None:
    """Find the element type in NDArray[x] or NDArray[x] | None."""
    if get_origin(hint) is np.ndarray:
        element = get_args(get_args(hint)[1])[0]
        if isinstance(element, type) and issubclass(element, np.generic):
            return np.dtype(element)
        return None
    for part in get_args(hint):
        found = _dtype_of(part)
        if found is not None:
            return found
    return None


def _is_stack(hint: Any) -> bool:
    """Tell FrameStack and FrameStack | None from arrays."""
    return hint is FrameStack or FrameStack in get_args(hint)


_LAYOUTS: dict[type, RecordLayout] = {}


def layout_of(record: type) -> RecordLayout:
    """Return the layout of a record class; raise `TypeError` for anything but a dataclass."""
    if record not in _LAYOUTS:
        _LAYOUTS[record] = _layout_of(record)
    return _LAYOUTS[record]


def _layout_of(record: type) -> RecordLayout:
    if not is_dataclass(record):
        raise TypeError(f"{record!r} is not a record")
    hints = get_type_hints(record)
    optional = {
        f.name for f in fields(record) if f.default is not MISSING or f.default_factory is not MISSING
    }
    declared = quantities(record)
    arrays = {
        name: ArrayField(q, _dtype_of(hints[name]), _is_stack(hints[name]), name in optional)
        for name, q in declared.items()
    }
    names = tuple(f.name for f in fields(record) if f.init and f.name not in declared)
    declare: Any = TypedDict  # the class is made of a record's fields: no checker can follow that
    plain = declare(record.__name__, {n: NotRequired[hints[n]] if n in optional else hints[n] for n in names})
    plain.__pydantic_config__ = ConfigDict(extra="forbid")
    return RecordLayout(record, arrays, names, TypeAdapter(plain))


def compact_json(value: Any) -> str:
    """Write JSON as short as can be; not a number and infinity as NaN and Infinity, which pydantic loses."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


def plain_to_json(record: Any) -> str:
    """Write the plain fields of a record as JSON; equal records give equal text."""
    layout = layout_of(type(record))
    values = {name: getattr(record, name) for name in layout.plain_names}
    return compact_json(layout.plain.dump_python(values, mode="json", warnings="error"))


def record_from_parts(record: type[R], plain: str | bytes, arrays: Mapping[str, Any], where: str) -> R:
    """Build a record from JSON and arrays; raise `ArchiveCorrupt`, naming `where`, if they do not fit."""
    try:
        values = layout_of(record).plain.validate_json(plain, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ArchiveCorrupt(
            f"{where} is not a {record.__name__}: {place}: {first['msg']}; was it written by another version?"
        ) from error
    return record(**values, **arrays)


def checked_array(name: str, field: ArrayField, value: Any) -> Any:
    """Return an array, or a frame stack, as its declaration says; raise `TypeError` if it is not.

    Arrays come back in C order and little-endian; a frame stack comes back as it is.
    """
    if field.streamed:
        shape, dtype, array = value.shape, np.dtype(value.dtype), value
        if dtype not in (np.uint8, np.uint16):
            raise TypeError(f"{name} is a stack of {dtype}; frames are uint8 or uint16")
    else:
        array = np.asarray(value)
        shape, dtype = array.shape, array.dtype
        if dtype.kind not in "biuf":
            raise TypeError(f"{name} holds {dtype}; the archive stores bool, integers and floats")
        if field.dtype is not None and dtype != field.dtype:
            raise TypeError(f"{name} is {dtype}, but declared {field.dtype}")
        array = np.ascontiguousarray(array, dtype=dtype.newbyteorder("<")).reshape(shape)
    axes, components = field.quantity.axes, field.quantity.components
    counts = {len(components), len(field.quantity.in_plane or components)}
    if len(shape) != len(axes):
        raise TypeError(f"{name} has shape {shape}, but is declared over {axes}")
    if components and "component" in axes and shape[axes.index("component")] not in counts:
        raise TypeError(f"{name} has shape {shape}, but its components are {components}")
    return array


@cache
def record_classes() -> dict[str, type]:
    """Return every record class of `sms_jobs.records`, by name."""
    found: dict[str, type] = {}
    for module in pkgutil.iter_modules(sms_jobs.records.__path__):
        name = f"{sms_jobs.records.__name__}.{module.name}"
        for value in vars(importlib.import_module(name)).values():
            if isinstance(value, type) and is_dataclass(value) and value.__module__ == name:
                found[value.__name__] = value
    return found


def class_named(name: str, where: str) -> type:
    """Return the record class of that name; raise `ArchiveCorrupt`, naming `where`, if there is none."""
    if name not in record_classes():
        raise ArchiveCorrupt(f"{where} holds a '{name}', which this version does not know")
    return record_classes()[name]
