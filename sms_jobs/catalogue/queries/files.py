"""Answers queries: the files that meet their conditions come by pages.

Files are found the newest first, by walking an index in the order of their numbers, which is quick where
many files meet the query. Where an index shows that few can, these alone are looked at (`_few`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Select, func, select
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue import search
from sms_jobs.catalogue.queries.conditions import Conditions
from sms_jobs.catalogue.queries.fields import Fields, Vocabulary
from sms_jobs.catalogue.queries.language import (
    A_COLUMN,
    UNWRITTEN,
    AllOf,
    Comparison,
    Condition,
    Name,
    Operator,
    Query,
    Value,
    comparisons,
    conjuncts,
)
from sms_jobs.catalogue.queries.names import Field
from sms_jobs.catalogue.queries.unknown_places import refuse_unknown_places
from sms_jobs.catalogue.tables.calibrations import CalibrationUseRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import InvalidInput
from sms_jobs.records.shown.files import Found, Page
from sms_jobs.records.shown.portion import FIRST, Portion

FEW = 4000
"""Up to so many files are looked at one by one rather than walked over in order."""


def find_page(
    session: Session,
    query: Query,
    vocabulary: Vocabulary,
    portion: Portion = FIRST,
) -> Page:
    """Return the files that meet a query.

    Parameters
    ----------
    vocabulary
        What the program knows besides the catalogue.
    portion
        Which page; of each file it tells what the query asks about if no columns are named.

    Raises
    ------
    InvalidInput
        A name is not known, or it is compared with what it cannot be compared with.
    NotFound
        There is no such campaign or calibration, or no state or view that the query is restricted to.
    """
    _walk_indexes(session)
    fields = Fields(session, vocabulary)
    asked, limit = _asked(fields, query, portion.columns), portion.limit
    ids = session.scalars(statement(session, query, fields, after=portion.after, limit=limit + 1)).all()
    if not ids and portion.after is None:
        refuse_unknown_places(session, query)
    following = ids[limit - 1] if len(ids) > limit else None
    return Page(tuple(asked), tuple(_found_files(session, ids[:limit], asked)), following)


def restricted(
    query: Query, *, kind: str | None, campaign: str | None, state: str | None, view: str | None
) -> Query:
    """Return a query for those files alone that are of a kind, campaign, state and view as well.

    Raises
    ------
    InvalidInput
        It asks for another kind already.
    """
    if kind is not None and query.kind is not None and query.kind.text != kind:
        raise InvalidInput(f"the query asks for {query.kind.text}, but `kind` is {kind}; leave one out")
    given = {"campaign": campaign, "state": state, "view": view}
    parts: list[Condition] = [
        Comparison(Name(name, UNWRITTEN), Operator.EQUAL, Value(text, text, UNWRITTEN))
        for name, text in given.items()
        if text is not None
    ]
    parts += conjuncts(query.condition)
    named = query.kind or (None if kind is None else Name(kind, UNWRITTEN))
    return Query(query.text, named, AllOf(tuple(parts)) if parts else None)


def check(session: Session, query: Query, vocabulary: Vocabulary) -> None:
    """Raise what `find_page` would raise, without looking for anything."""
    fields = Fields(session, vocabulary)
    Conditions(session, query, fields).all_of(conjuncts(query.condition))


def statement(
    session: Session, query: Query, fields: Fields, *, after: int | None = None, limit: int = 50
) -> Select[int]:
    """Return the statement that finds the numbers of the files, chosen by what the indexes show."""
    if query.kind is not None:
        fields.refuse_unknown_kind(query.kind, query.text)
    conditions = Conditions(session, query, fields)
    parts = conjuncts(query.condition)
    found = select(FileRow.id)
    if query.kind is not None:
        found = found.where(FileRow.source == query.kind.text)
    number: ColumnElement[int] = FileRow.id.expression
    few = _few(session, conditions.sources())
    of_calibration = conditions.of_one_calibration()
    if few is not None:
        source, count = few
        # The limit tells the database how few they are; files that come in meanwhile find room in it.
        found = found.where(FileRow.id.in_(select(source.limit(2 * count + 100).subquery().c[0])))
        _walk_indexes(session, sort=True)
    elif of_calibration is not None:
        # The index of its files is walked, in place of that of all files.
        part, calibration = of_calibration
        parts = tuple(other for other in parts if other is not part)
        used = aliased(CalibrationUseRow)
        found = found.join(used, used.file_id == FileRow.id).where(used.calibration_id == calibration)
        number = used.file_id.expression
    found = found.where(conditions.all_of(parts))
    if after is not None:
        found = found.where(number < after)
    return found.order_by(number.desc()).limit(limit)


def _walk_indexes(session: Session, *, sort: bool = False) -> None:
    """Let PostgreSQL keep to indexes in this transaction, and to sorting what comes out of them or not.

    It cannot know how many files meet a condition, guesses that they are few, and would then rather look at
    all of them and sort than walk an index until a page is full.
    """
    if session.get_bind().dialect.name == "postgresql":
        on = {"enable_seqscan": False, "enable_bitmapscan": False, "enable_sort": sort, "jit": False}
        session.execute(select(*(func.set_config(n, "on" if v else "off", True) for n, v in on.items())))


def _few(session: Session, sources: Sequence[Select[int]]) -> tuple[Select[int], int] | None:
    """Return the source with the fewest files and their number, None if all have many."""
    best = None
    for source in sources:
        # No more are counted than make a difference.
        most = FEW if best is None else best[1]
        counted = session.scalar(select(func.count()).select_from(source.limit(most + 1).subquery())) or 0
        if counted <= most:
            best = (source, counted)
    return best


def _asked(fields: Fields, query: Query, columns: Sequence[str] | None) -> dict[str, Field]:
    """Return what to show of each file: the columns that were asked for, or what the query compares."""
    if columns is not None:
        return {c: fields.field(Name(c, A_COLUMN), c) for c in columns}
    tests = [test for test in comparisons(query.condition) if test.name.at != UNWRITTEN]
    compared = [fields.tested(test, query.text) for test in tests]
    # A calibration that a query compares stands in the query itself.
    return {field.name: field for field in compared if field.type != "calibration"}


def _found_files(session: Session, ids: Sequence[int], asked: dict[str, Field]) -> Iterator[Found]:
    extra = [field.column.label(f"value_{place}") for place, field in enumerate(asked.values())]
    by_id = {
        file.id: Found(file, {n: _value(f, v) for (n, f), v in zip(asked.items(), values, strict=True)})
        for file, values in search.views_with(session, ids, extra)
    }
    # One that was removed in the meantime is left out.
    yield from (by_id[key] for key in ids if key in by_id)


def _value(field: Field, value: Any) -> Any:
    if field.type == "calibration":
        # The database has them in no certain order.
        return None if value is None else ", ".join(sorted(value.split(","), key=int))
    if field.type == "parameter":
        value = (value or {}).get(field.stored)
        value = value if value is None or isinstance(value, bool | int | float | str) else str(value)
    if field.factor == 1.0 or not isinstance(value, int | float):
        return value
    return value / field.factor
