"""How tables of a file become records: known keys, exact types, angles in degrees, limits by name."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from math import radians
from types import GenericAlias, UnionType
from typing import Annotated, Any, TypeAlias, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetPydanticSchema,
    PlainValidator,
    create_model,
    model_validator,
)
from pydantic_core import PydanticCustomError, PydanticKnownError, core_schema

from sms_jobs.records.gray_code import LARGEST_BITS, GrayCode, Threshold
from sms_jobs.records.sensors import Box

_POSITIVE = (
    *("width_mm", "height_mm", "radius_mm", "size_mm", "depth_mm", "diameter_mm"),
    *("pitch_mm", "length_mm", "fade_mm", "sigma_mm", "pitch_relative_sigma"),
    *("exposure", "full_well", "gamma", "strength", "exponent"),
)
"""Endings of the names of fields that must be above zero."""
_NOT_NEGATIVE = frozenset(
    {
        "read_noise",
        "blur_px",
        "defocus_px",
        "ambient",
        "hole_offset_mm",
        "seed",
        "margin_mm",
        "marker_hole_mm",
        "point_sigma_mm",
        "flatness_mm",
    }
)
_FRACTIONS = frozenset({"dark", "bright", "visibility", "mirror_reflectance"})

Vector: TypeAlias = tuple[float, float, float]


def _number(value: Any) -> int | float:
    """Return a number as it was written, whole or not."""
    if type(value) not in (int, float):
        raise PydanticKnownError("float_type")
    return cast(int | float, value)


def _counts(value: Any) -> int | tuple[int, ...]:
    """Return a whole number, or several."""
    if not all(type(one) is int for one in (value if isinstance(value, list | tuple) else (value,))):
        raise PydanticKnownError("int_type")
    return tuple(value) if isinstance(value, list) else cast(int | tuple[int, ...], value)


Number: TypeAlias = Annotated[int | float, PlainValidator(_number)]
Counts: TypeAlias = Annotated[int | tuple[int, ...], PlainValidator(_counts)]


class Table(BaseModel):
    """A table of the file: exact types, finite numbers, known keys alone."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: Any) -> Any:
        known = [f.alias or name for name, f in cls.model_fields.items()]
        for key in value if isinstance(value, dict) else ():
            if key not in known:
                raise PydanticCustomError(
                    "unknown_key",
                    "has no key '{key}'; its keys are {known}",
                    {"key": key, "known": ", ".join(known)},
                )
        return value


@cache
def table_of(record: type) -> Any:
    """Return the table that describes a record: its fields, radians written as degrees, records as tables."""
    hints = get_type_hints(record)
    columns: dict[str, Any] = {}
    for f in fields(record):
        limits: dict[str, Any] = {}
        if f.name.endswith("angle_rad"):
            limits = {"gt": 0.0, "le": 180.0}
        elif f.name.endswith(_POSITIVE):
            limits = {"gt": 0.0}
        elif f.name in _NOT_NEGATIVE:
            limits = {"ge": 0}
        elif f.name in _FRACTIONS:
            limits = {"ge": 0.0, "le": 1.0}
        elif f.name in ("columns", "rows"):
            limits = {"ge": 2}
        kind = hints[f.name]
        if limits and kind == tuple[float, float]:
            one = Annotated[float, Field(**limits)]
            kind, limits = tuple[one, one], {}
        name = f.name.removesuffix("_rad") + "_deg" if f.name.endswith("_rad") else f.name
        default = f.default if f.default is not MISSING else ...
        if name in ("shape", "motion"):
            default = ...  # the file says what it is
        elif name != f.name and default is not ...:
            default = mapped(np.degrees, default)
        columns[name] = (_with_tables(kind), Field(default, **limits))
    return create_model(record.__name__, __base__=Table, **columns)


def _with_tables(kind: Any) -> Any:
    """Return a type with tables in place of records, which may stand in a tuple or beside None."""
    if isinstance(kind, type) and is_dataclass(kind):
        return table_of(kind)
    parts = tuple(_with_tables(part) for part in get_args(kind))
    if get_origin(kind) is tuple:
        return GenericAlias(tuple, parts)
    return Union[parts] if isinstance(kind, UnionType) else kind  # noqa: UP007


def _with_records(kind: Any, value: Any) -> Any:
    """Return a value of a type with the records that its tables describe: the inverse of `_with_tables`."""
    if isinstance(kind, type) and is_dataclass(kind):
        return record_of(kind, value)
    if isinstance(value, tuple) and any(map(is_dataclass, get_args(kind))):
        return tuple(_with_records(get_args(kind)[0], one) for one in value)
    if isinstance(kind, UnionType) and value is not None:
        return next((_with_records(k, value) for k in get_args(kind) if is_dataclass(k)), value)
    return value


def mapped(function: Any, value: Any) -> Any:
    """Apply a function of one number to a number or to each of a tuple."""
    return tuple(float(function(v)) for v in value) if isinstance(value, tuple) else float(function(value))


def record_of(kind: type, table: Any) -> Any:
    """Return the record that a table describes."""
    values = {}
    hints = get_type_hints(kind)
    for f in fields(kind):
        if f.name.endswith("_rad"):
            values[f.name] = mapped(radians, getattr(table, f.name.removesuffix("_rad") + "_deg"))
        else:
            values[f.name] = _with_records(hints[f.name], getattr(table, f.name))
    return kind(**values)


def flat(*kinds: type, tag: str | None = None) -> GetPydanticSchema:
    """Read one of several records, told apart by the value of their field `tag`."""
    kind_of = {table_of(kind): kind for kind in kinds}
    table: Any = Union[tuple(kind_of)]  # noqa: UP007
    if tag is not None:
        table = Annotated[table, Field(discriminator=tag)]
    return GetPydanticSchema(
        lambda _, handler: core_schema.no_info_after_validator_function(
            lambda found: record_of(kind_of[type(found)], found), handler(table)
        )
    )


class Placement(Table):
    """Where something stands: a rotation vector in degrees, then a translation."""

    rotation_deg: Vector = (0.0, 0.0, 0.0)
    translation_mm: Vector = (0.0, 0.0, 0.0)


class Volume(Table):
    """A box along the world's axes."""

    low_mm: Vector
    high_mm: Vector

    @model_validator(mode="after")
    def _not_empty(self) -> Volume:
        if any(low >= high for low, high in zip(self.low_mm, self.high_mm, strict=True)):
            raise PydanticCustomError("empty", "needs every coordinate of low_mm below that of high_mm")
        return self

    def record(self) -> Box:
        """Return the box."""
        return Box(self.low_mm, self.high_mm)


def _several(value: Any) -> Any:
    return (value,) if isinstance(value, int | float) else value


Stripes = Annotated[tuple[Annotated[float, Field(ge=2.0)], ...], BeforeValidator(_several)]
"""Stripes of a Gray code: one number, or one for each orientation; empty for all that its bits tell apart."""


class GrayTable(Table):
    """A Gray code as files describe it."""

    bits: Annotated[int, Field(ge=1, le=LARGEST_BITS)]
    stripes: Stripes = ()

    def code(self, threshold: Threshold) -> GrayCode:
        """Return the code, with a threshold."""
        return GrayCode(self.bits, self.stripes or (float(2**self.bits),), threshold)
