"""How tables within tables of a file become records within records: known keys, exact types, degrees."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from math import degrees, radians
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import Field, GetPydanticSchema, create_model
from pydantic_core import PydanticCustomError, core_schema

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.record_tables import Table

_ANGLES = (("_rad", "_deg"), ("_rad_s", "_deg_s"), ("_rad_s2", "_deg_s2"))


def nested(record: type) -> GetPydanticSchema:
    """Read a record whose fields may be records, or tuples of records.

    Angles, `..._rad` in the record, are `..._deg` in the file. What a record itself refuses is refused with
    the place in the file.
    """
    table = _table_of(record)
    return GetPydanticSchema(
        lambda _, handler: core_schema.no_info_after_validator_function(
            lambda found: _record(record, found), handler(table)
        )
    )


def one_of(records: Iterable[type], tag: str) -> GetPydanticSchema:
    """Read one of several such records, told apart by the literal value of their field `tag`."""
    kinds = {_table_of(record): record for record in records}
    table: Any = Annotated[Union[tuple(kinds)], Field(discriminator=tag)]  # noqa: UP007
    if len(kinds) == 1:
        (table,) = kinds
    return GetPydanticSchema(
        lambda _, handler: core_schema.no_info_after_validator_function(
            lambda found: _record(kinds[type(found)], found), handler(table)
        )
    )


@cache
def _table_of(record: type) -> Any:
    hints = get_type_hints(record)
    columns: dict[str, Any] = {}
    for f in fields(record):
        name = _written(f.name)
        default: Any = f.default if f.default is not MISSING else ...
        if f.default_factory is not MISSING:
            default = f.default_factory()
        if name != f.name and isinstance(default, float):
            default = degrees(default)
        columns[name] = (_hint(hints[f.name]), Field(default))
    return create_model(record.__name__, __base__=Table, **columns)


def _hint(hint: Any) -> Any:
    """Return the type of a field of the table for that of a field of the record."""
    if is_dataclass(hint):
        return Annotated[hint, nested(hint)] if isinstance(hint, type) else hint
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return hint
    if origin in (Union, UnionType):
        return Union[tuple(_hint(p) for p in parts)]  # noqa: UP007
    if origin is tuple:
        inner: Any = tuple(p if p is ... else _hint(p) for p in parts)
        return tuple.__class_getitem__(inner)
    return hint


def _record(record: type, table: Any) -> Any:
    """Return the record that a table describes."""
    values = {}
    for f in fields(record):
        name = _written(f.name)
        value = getattr(table, name)
        values[f.name] = radians(value) if name != f.name else value
    try:
        return record(**values)
    except InvalidInput as error:
        raise PydanticCustomError("refused", "cannot be used: {why}", {"why": str(error)}) from None


def _written(name: str) -> str:
    """Return the key of a field."""
    for ours, theirs in _ANGLES:
        if name.endswith(ours):
            return name.removesuffix(ours) + theirs
    return name
