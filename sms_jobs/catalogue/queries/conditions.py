"""The conditions of a query as SQL with bound values, and the indexes that they can be looked up in."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Select,
    and_,
    exists,
    false,
    not_,
    select,
    union_all,
)
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.parts import AT_ONCE
from sms_jobs.catalogue.queries.comparisons import Comparisons, expression, parameter_type
from sms_jobs.catalogue.queries.fields import Fields, parameter_as
from sms_jobs.catalogue.queries.language import (
    AnyOf,
    Between,
    Comparison,
    Condition,
    Membership,
    Operator,
    Query,
    Test,
    conjuncts,
    refuse,
    values_of,
)
from sms_jobs.catalogue.queries.names import Field
from sms_jobs.catalogue.tables.calibrations import CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import NotFound


class Conditions:
    """The conditions of a query as expressions about rows of `file`.

    Every method raises `InvalidInput` for a name that is not known or is compared with what it cannot be
    compared with, `NotFound` for a campaign or calibration that is not there.
    """

    def __init__(self, session: Session, query: Query, fields: Fields) -> None:
        self._session = session
        self._query = query
        self._fields = fields
        self._comparisons = Comparisons(query.text)
        self._dialect = session.get_bind().dialect.name
        self._known: set[int] = set()

    def all_of(self, parts: Sequence[Condition]) -> ColumnElement[bool]:
        """Return whether a file meets all of some conditions."""
        return and_(True, *(expression(part, self._leaf) for part in parts))

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
                of_state.append(self._comparisons.test(part, field, field.of_state))
            elif field.sources:
                found = [s.files.where(self._comparisons.test(part, field, s.indexed)) for s in field.sources]
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
        return self._fields.tested(part, self._query.text)

    def _leaf(self, part: Test) -> ColumnElement[bool]:
        field = self._field(part)
        if field.type == "campaign":
            return self._campaign(part)
        if field.type == "calibration":
            return self._calibration(part)
        column = self._parameter(part, field) if field.type == "parameter" else field.column
        return self._comparisons.test(part, field, column)

    def _parameter(self, part: Test, field: Field) -> ColumnElement[Any]:
        values = values_of(part)
        kinds = {parameter_type(value) for value in values}
        if len(kinds) > 1:
            self._comparisons.refuse(values[-1], f"'{field.name}' is compared with values of different sorts")
        return parameter_as(field, kinds.pop(), self._dialect)

    def _campaign(self, part: Test) -> ColumnElement[bool]:
        """Compare the campaign's number, on which the indexes of `file` begin."""
        if isinstance(part, Comparison) and part.operator not in (Operator.EQUAL, Operator.UNEQUAL):
            field = self._field(part)
            condition = self._comparisons.test(
                part, Field("campaign", "text", field.column), CampaignRow.name.expression
            )
            alike = select(CampaignRow.id).where(condition)
            numbers = self._session.scalars(alike.limit(AT_ONCE + 1)).all()
            if len(numbers) > AT_ONCE:
                return FileRow.campaign_id.in_(alike)
        else:
            numbers = [campaigns.campaign_id(self._session, value.text) for value in values_of(part)]
        if isinstance(part, Comparison) and part.operator is Operator.UNEQUAL:
            return FileRow.campaign_id.not_in(numbers)
        if not numbers:
            return false()
        return FileRow.campaign_id == numbers[0] if len(numbers) == 1 else FileRow.campaign_id.in_(numbers)

    def _calibrations(self, part: Test) -> list[int]:
        numbers = []
        for value in values_of(part):
            number = value.value
            if not isinstance(number, float) or not number.is_integer() or abs(number) >= 2.0**31:
                self._comparisons.refuse(value, "a calibration is asked for by its number")
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


def _together(selections: Sequence[Select[int]]) -> Select[int]:
    """Select what any of some selections selects; what several do comes several times."""
    subqueries = [one.subquery() for one in selections]
    return select(union_all(*(select(k.c[0]) for k in subqueries)).subquery().c[0])


def _uses_index(part: Test) -> bool:
    return not isinstance(part, Comparison) or part.operator not in (Operator.CONTAINS, Operator.UNEQUAL)
