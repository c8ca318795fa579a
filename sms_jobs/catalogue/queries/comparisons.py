"""The tests of a query as SQL with bound values, about whatever expression a name means."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, NoReturn

from sqlalchemy import BigInteger, ColumnElement, Double, Integer, and_, literal, not_, or_

from sms_jobs.catalogue.queries.language import (
    YEAR,
    AllOf,
    AnyOf,
    Between,
    Condition,
    Membership,
    Not,
    Operator,
    Test,
    Value,
    refuse,
)
from sms_jobs.catalogue.queries.names import Field

_COMPARED: dict[Operator, Callable[[Any, Any], ColumnElement[bool]]] = {
    Operator.EQUAL: operator.eq,
    Operator.UNEQUAL: operator.ne,
    Operator.LESS: operator.lt,
    Operator.AT_MOST: operator.le,
    Operator.GREATER: operator.gt,
    Operator.AT_LEAST: operator.ge,
}
_ROUNDING = 1e-12
"""Relative; a value that was converted from another unit may be off by so much."""


def expression(condition: Condition, of: Callable[[Test], ColumnElement[bool]]) -> ColumnElement[bool]:
    """Return a condition as an expression, given that of each of its tests."""
    if isinstance(condition, Not):
        return not_(expression(condition.condition, of))
    if isinstance(condition, AllOf):
        return and_(*(expression(part, of) for part in condition.conditions))
    if isinstance(condition, AnyOf):
        return or_(*(expression(part, of) for part in condition.conditions))
    return of(condition)


@dataclass(frozen=True)
class Comparisons:
    """Compares expressions with the values of a query.

    Attributes
    ----------
    text
        Of the query, where the place of a value that cannot be compared is pointed at by `InvalidInput`.
    """

    text: str

    def test(self, part: Test, field: Field, column: ColumnElement[Any]) -> ColumnElement[bool]:
        """Return whether an expression, in the unit of the field's column, meets a test."""
        if isinstance(part, Membership):
            return or_(*(self._compare(field, column, Operator.EQUAL, value) for value in part.values))
        if isinstance(part, Between):
            return and_(
                self._compare(field, column, Operator.AT_LEAST, part.low),
                self._compare(field, column, Operator.AT_MOST, part.high),
            )
        return self._compare(field, column, part.operator, part.value)

    def _compare(
        self, field: Field, column: ColumnElement[Any], sign: Operator, value: Value
    ) -> ColumnElement[bool]:
        kind = parameter_type(value) if field.type == "parameter" else field.type
        if sign is Operator.CONTAINS:
            if kind not in ("text", "prefix"):
                self.refuse(value, f"'{field.name}' has no text in it; ~ looks for a part of a text")
            return column.icontains(value.text, autoescape=True)
        if kind == "number":
            return self._compare_number(field, column, sign, value)
        if kind == "time":
            return self._compare_time(field, column, sign, value)
        if kind == "truth":
            return _COMPARED[sign](column, value.text.lower() == "true")
        if kind == "prefix" and sign in (Operator.EQUAL, Operator.UNEQUAL):
            # Numbers of jobs are hexadecimal: nothing that begins so comes after "g".
            begins = and_(column >= value.text.lower(), column < f"{value.text.lower()}g")
            return begins if sign is Operator.EQUAL else not_(begins)
        return _COMPARED[sign](column, value.text)

    def _compare_number(
        self, field: Field, column: ColumnElement[Any], sign: Operator, value: Value
    ) -> ColumnElement[bool]:
        if not isinstance(value.value, float):
            self.refuse(value, f"'{field.name}' is a number, and '{value.text}' is none")
        number = value.value * field.factor
        if field.factor != 1.0 and sign in (Operator.EQUAL, Operator.UNEQUAL):
            off = abs(number) * _ROUNDING
            near = column.between(number - off, number + off)
            return near if sign is Operator.EQUAL else not_(near)
        # Whole numbers stay so where the column has such: an index on them knows no others.
        whole = isinstance(column.type, Integer) and number.is_integer() and abs(number) < 2.0**53
        return _COMPARED[sign](column, literal(int(number), BigInteger) if whole else literal(number, Double))

    def _compare_time(
        self, field: Field, column: ColumnElement[Any], sign: Operator, value: Value
    ) -> ColumnElement[bool]:
        """Compare times; a day, month or year is all the time from its first midnight to that after it."""
        begin, end = self._period(field, value)
        if end is None:
            return _COMPARED[sign](column, begin)
        within = and_(column >= begin, column < end)
        return {
            Operator.EQUAL: within,
            Operator.UNEQUAL: not_(within),
            Operator.LESS: column < begin,
            Operator.AT_MOST: column < end,
            Operator.GREATER: column >= end,
            Operator.AT_LEAST: column >= begin,
        }[sign]

    def _period(self, field: Field, value: Value) -> tuple[datetime, datetime | None]:
        """Return begin and end of what is written as a time; a moment has no end."""
        try:
            if isinstance(value.value, float) and YEAR.fullmatch(value.text):
                year = int(value.text)
                return datetime(year, 1, 1).astimezone(), datetime(year + 1, 1, 1).astimezone()
            if not isinstance(value.value, datetime):
                self.refuse(
                    value,
                    f"'{field.name}' is a time like 2026-05-01 or 2026-05-01T14:30, or a month like 2026-05",
                )
            if len(value.text) == len("2026-05"):
                later = datetime.fromisoformat(f"{value.text}-01") + timedelta(days=31)
                return value.value, later.replace(day=1).astimezone()
            if len(value.text) == len("2026-05-01"):
                return value.value, (datetime.fromisoformat(value.text) + timedelta(days=1)).astimezone()
        except OverflowError:
            self.refuse(value, "this day is too late")
        return value.value, None

    def refuse(self, value: Value, why: str) -> NoReturn:
        """Raise `InvalidInput` that points at a value."""
        refuse(self.text, value.at, why)


def parameter_type(value: Value) -> Any:
    """Return as what a parameter of a job is compared with a value: number, truth or text."""
    if isinstance(value.value, float):
        return "number"
    return "truth" if value.text.lower() in ("true", "false") else "text"
