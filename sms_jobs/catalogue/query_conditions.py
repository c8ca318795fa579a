"""The conditions of a query as SQL with bound values, and the indexes that they can be looked up in."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timedelta
from typing import Any, NoReturn

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Double,
    Integer,
    Select,
    and_,
    exists,
    false,
    literal,
    not_,
    or_,
    select,
    union_all,
)
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.models import CalibrationRow, CalibrationUseRow, CampaignRow, FileRow, LoadStateRow
from sms_jobs.catalogue.parts import AT_ONCE
from sms_jobs.catalogue.query_fields import Field, Fields, parameter_as
from sms_jobs.catalogue.query_language import (
    AllOf,
    AnyOf,
    Between,
    Comparison,
    Condition,
    Membership,
    Not,
    Operator,
    Query,
    Test,
    Value,
    conjuncts,
    refuse,
)
from sms_jobs.errors import NotFound

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


class Conditions:
    """The conditions of a query as expressions about rows of `file`.

    Every method raises `InvalidInput` for a name that is not known or is compared with what it cannot be
    compared with, `NotFound` for a campaign or calibration that is not there.
    """

    def __init__(self, session: Session, query: Query, fields: Fields) -> None:
        self._session = session
        self._query = query
        self._fields = fields
        self._dialect = session.get_bind().dialect.name
        self._known: set[int] = set()

    def all_of(self, parts: Sequence[Condition]) -> ColumnElement[bool]:
        """Return whether a file meets all of some conditions."""
        return and_(True, *(self._expression(part) for part in parts))

    def sources(self) -> list[Select[int]]:
        """Return selections of file numbers by an index; each has every file that meets the query."""
        return list(self._sources(self._query.condition))

    def of_one_calibration(self) -> tuple[Condition, int] | None:
        """Return what asks for the files of one calibration, and its number, if the query does."""
        for part in conjuncts(self._query.condition):
            if not isinstance(part, Comparison) or part.operator is not Operator.EQUAL:
                continue
            if self._field(part).type == "calibration":
                return part, self._calibrations(part)[0]
        return None

    def _sources(self, condition: Condition | None) -> Iterator[Select[int]]:
        of_state = []
        for part in conjuncts(condition):
            if isinstance(part, AnyOf):
                yield from self._union(part)
            if not isinstance(part, Comparison | Membership | Between):
                continue
            field = self._field(part)
            if field.type == "calibration":
                yield from self._calibrated(part)
            elif not _uses_index(part):
                continue
            elif field.of_state is not None:
                of_state.append(self._test(part, field, field.of_state))
            elif field.sources:
                found = [s.files.where(self._test(part, field, s.indexed)) for s in field.sources]
                yield found[0] if len(found) == 1 else _together(found)
        if of_state:
            held = select(FileRow.id).join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
            yield held.where(*of_state)

    def _union(self, part: AnyOf) -> Iterator[Select[int]]:
        branches = [next(self._sources(one), None) for one in part.conditions]
        complete = [branch for branch in branches if branch is not None]
        if len(complete) == len(branches):
            yield _together(complete)

    def _calibrated(self, part: Test) -> Iterator[Select[int]]:
        if isinstance(part, Comparison) and part.operator is Operator.EQUAL:
            (number,) = self._calibrations(part)
            yield select(CalibrationUseRow.file_id).where(CalibrationUseRow.calibration_id == number)

    def _field(self, part: Test) -> Field:
        return self._fields.field(part.name, self._query.text)

    def _expression(self, condition: Condition) -> ColumnElement[bool]:
        if isinstance(condition, Not):
            return not_(self._expression(condition.condition))
        if isinstance(condition, AllOf):
            return and_(*(self._expression(part) for part in condition.conditions))
        if isinstance(condition, AnyOf):
            return or_(*(self._expression(part) for part in condition.conditions))
        field = self._field(condition)
        if field.type == "campaign":
            return self._campaign(condition)
        if field.type == "calibration":
            return self._calibration(condition)
        if field.type == "parameter":
            return self._test(condition, field, self._parameter(condition, field))
        return self._test(condition, field, field.column)

    def _test(self, part: Test, field: Field, column: ColumnElement[Any]) -> ColumnElement[bool]:
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
        kind = _parameter_type(value) if field.type == "parameter" else field.type
        if sign is Operator.CONTAINS:
            if kind not in ("text", "prefix"):
                self._refuse(value, f"'{field.name}' has no text in it; ~ looks for a part of a text")
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
            self._refuse(value, f"'{field.name}' is a number, and '{value.text}' is none")
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
        """Compare times; a day is all the time from its midnight to the next."""
        begin = value.value
        if not isinstance(begin, datetime):
            self._refuse(value, f"'{field.name}' is a time like 2026-05-01 or 2026-05-01T14:30")
        if len(value.text) > len("2026-05-01"):
            return _COMPARED[sign](column, begin)
        try:
            end = (datetime.fromisoformat(value.text) + timedelta(days=1)).astimezone()
        except OverflowError:
            self._refuse(value, "this day is too late")
        within = and_(column >= begin, column < end)
        return {
            Operator.EQUAL: within,
            Operator.UNEQUAL: not_(within),
            Operator.LESS: column < begin,
            Operator.AT_MOST: column < end,
            Operator.GREATER: column >= end,
            Operator.AT_LEAST: column >= begin,
        }[sign]

    def _parameter(self, part: Test, field: Field) -> ColumnElement[Any]:
        values = _values(part)
        kinds = {_parameter_type(value) for value in values}
        if len(kinds) > 1:
            self._refuse(values[-1], f"'{field.name}' is compared with values of different sorts")
        return parameter_as(field, kinds.pop(), self._dialect)

    def _campaign(self, part: Test) -> ColumnElement[bool]:
        """Compare the campaign's number, on which the indexes of `file` begin."""
        if isinstance(part, Comparison) and part.operator not in (Operator.EQUAL, Operator.UNEQUAL):
            field = self._field(part)
            condition = self._test(part, Field("campaign", "text", field.column), CampaignRow.name.expression)
            alike = select(CampaignRow.id).where(condition)
            numbers = self._session.scalars(alike.limit(AT_ONCE + 1)).all()
            if len(numbers) > AT_ONCE:
                return FileRow.campaign_id.in_(alike)
        else:
            numbers = [campaigns.campaign_id(self._session, value.text) for value in _values(part)]
        if isinstance(part, Comparison) and part.operator is Operator.UNEQUAL:
            return FileRow.campaign_id.not_in(numbers)
        if not numbers:
            return false()
        return FileRow.campaign_id == numbers[0] if len(numbers) == 1 else FileRow.campaign_id.in_(numbers)

    def _calibrations(self, part: Test) -> list[int]:
        numbers = []
        for value in _values(part):
            number = value.value
            if not isinstance(number, float) or not number.is_integer() or abs(number) >= 2.0**31:
                self._refuse(value, "a calibration is asked for by its number")
            numbers.append(int(number))
            if numbers[-1] not in self._known and self._session.get(CalibrationRow, numbers[-1]) is None:
                raise NotFound(f"there is no calibration {value.text}; 'sms calibration list' shows them")
            self._known.add(numbers[-1])
        return numbers

    def _calibration(self, part: Test) -> ColumnElement[bool]:
        """Whether a file was computed with one of some calibrations."""
        plain = isinstance(part, Membership) or (
            isinstance(part, Comparison) and part.operator in (Operator.EQUAL, Operator.UNEQUAL)
        )
        if not plain:
            refuse(self._query.text, part.name.at, "a calibration is compared with =, != or in")
        used = exists().where(
            CalibrationUseRow.file_id == FileRow.id,
            CalibrationUseRow.calibration_id.in_(self._calibrations(part)),
        )
        unwanted = isinstance(part, Comparison) and part.operator is Operator.UNEQUAL
        return not_(used) if unwanted else used

    def _refuse(self, value: Value, why: str) -> NoReturn:
        refuse(self._query.text, value.at, why)


def _together(selections: Sequence[Select[int]]) -> Select[int]:
    """Select what any of some selections selects; what several do comes several times."""
    subqueries = [one.subquery() for one in selections]
    return select(union_all(*(select(k.c[0]) for k in subqueries)).subquery().c[0])


def _uses_index(part: Test) -> bool:
    return not isinstance(part, Comparison) or part.operator not in (Operator.CONTAINS, Operator.UNEQUAL)


def _values(part: Test) -> tuple[Value, ...]:
    if isinstance(part, Membership):
        return part.values
    return (part.low, part.high) if isinstance(part, Between) else (part.value,)


def _parameter_type(value: Value) -> Any:
    if isinstance(value.value, float):
        return "number"
    return "truth" if value.text.lower() in ("true", "false") else "text"
