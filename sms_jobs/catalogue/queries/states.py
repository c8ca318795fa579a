"""Answers queries about load states: those that meet their conditions come by pages.

A state meets a condition about views if one of its views meets the whole of it. The database walks states,
which are thousands where files are hundreds of thousands, and looks up what is asked of each by indexes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Select, and_, exists, func, null, or_, select, true
from sqlalchemy.orm import Session, aliased

from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.queries.comparisons import Comparisons, expression
from sms_jobs.catalogue.queries.fields import Fields, Vocabulary
from sms_jobs.catalogue.queries.language import (
    UNWRITTEN,
    Comparison,
    Condition,
    Operator,
    Query,
    Test,
    comparisons,
    conjuncts,
    values_of,
)
from sms_jobs.catalogue.queries.names import Field
from sms_jobs.catalogue.queries.state_fields import SEEN, ResultStatistic, StateField, StateFields
from sms_jobs.catalogue.queries.unknown_places import refuse_unknown_places
from sms_jobs.catalogue.tables.files import FileRow, StatisticRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.shown.portion import FIRST, Portion
from sms_jobs.records.shown.states import FoundState, StatePage, Value
from sms_jobs.records.views import place_of_view


def find_page(
    session: Session,
    query: Query,
    vocabulary: Vocabulary,
    dataset_type: str,
    portion: Portion = FIRST,
) -> StatePage:
    """Return the states that meet a query.

    Parameters
    ----------
    vocabulary
        What the program knows besides the catalogue.
    dataset_type
        Media type of results.
    portion
        Which page; of each state it tells campaign, state, load, time and what the query asks about if no
        columns are named.

    Raises
    ------
    InvalidInput
        A name is not known, or it is compared with what it cannot be compared with.
    NotFound
        There is no such campaign, no state or view that the query is restricted to, or none to go on after.
    """
    if query.kind is not None:
        Fields(session, vocabulary).refuse_unknown_kind(query.kind, query.text)
    fields = StateFields(session, query, dataset_type)
    asked, limit = _asked(fields, query, portion.columns), portion.limit
    conditions = _Conditions(session, query, fields)
    found = select(LoadStateRow.id).where(conditions.of_states())
    if portion.after is not None:
        found = found.where(_after(session, portion.after))
    in_order = found.order_by(LoadStateRow.campaign_id.desc(), LoadStateRow.position, LoadStateRow.id)
    ids = session.scalars(in_order.limit(limit + 1)).all()
    if not ids and portion.after is None:
        refuse_unknown_places(session, query)
    following = ids[limit - 1] if len(ids) > limit else None
    by_view = tuple(name for name, one in asked.items() if one.by_view)
    told = tuple(_states(session, ids[:limit], asked, dataset_type, conditions))
    return StatePage(tuple(asked), by_view, told, following)


class _Conditions:
    """The conditions of a query as expressions about rows of `load_state`; raises as `find_page` does."""

    def __init__(self, session: Session, query: Query, fields: StateFields) -> None:
        self._session = session
        self._query = query
        self._comparisons = Comparisons(query.text)
        self._tests = {id(test): fields.tested(test) for test in comparisons(query.condition)}
        by_view = [one for one in self._tests.values() if one.by_view]
        self._kind = None if query.kind is None else query.kind.text
        self._kind_by_view = self._kind is not None and fields.is_by_view(self._kind)
        self.about_views = bool(by_view) or self._kind_by_view
        # Where nothing but statistics is asked of views, those without any are as if they were not there.
        told = {one.statistic.kind for one in by_view if one.statistic is not None}
        self._sources = told if all(one.statistic is not None for one in by_view) else set()

    def of_states(self) -> ColumnElement[bool]:
        """Return whether a state meets the query."""
        parts = conjuncts(self._query.condition)
        whole = [expression(part, self._leaf) for part in parts if not self._asks_views(part)]
        if self._kind is not None and not self._kind_by_view:
            file = aliased(FileRow)
            whole.append(
                exists().where(
                    file.state_id == LoadStateRow.id, file.source == self._kind, file.view.is_(None)
                )
            )
        if self.about_views:
            by_one = exists().where(SEEN.state_id == LoadStateRow.id, *self.of_views())
            # What is known of the state alone may be enough: load > 50 kN or valid_fraction < 0.8.
            alone = [expression(part, self._leaf_unseen) for part in parts if self._asks_views(part)]
            whole.append(by_one if self._kind_by_view else or_(by_one, and_(*alone)))
        return and_(true(), *whole)

    def of_views(self) -> list[ColumnElement[bool]]:
        """Return what a file of a state has to be for its view to meet what is asked about views."""
        asked = [p for p in conjuncts(self._query.condition) if self._asks_views(p)]
        found = [SEEN.view.is_not(None), *(expression(part, self._leaf) for part in asked)]
        if self._kind_by_view:
            found.append(SEEN.source == self._kind)
        elif self._sources:
            found.append(SEEN.source.in_(sorted(self._sources)))
        return found

    def _asks_views(self, condition: Condition) -> bool:
        return any(self._tests[id(test)].by_view for test in comparisons(condition))

    def _leaf_unseen(self, part: Test) -> ColumnElement[bool]:
        # Of no view nothing is known that views tell.
        return null() if self._tests[id(part)].by_view else self._leaf(part)  # type: ignore[return-value]

    def _leaf(self, part: Test) -> ColumnElement[bool]:
        field = self._tests[id(part)].field
        if field.type == "campaign":
            return self._campaign(part, field)
        return self._comparisons.test(part, field, field.column)

    def _campaign(self, part: Test, field: Field) -> ColumnElement[bool]:
        if isinstance(part, Comparison) and part.operator not in (Operator.EQUAL, Operator.UNEQUAL):
            return self._comparisons.test(part, Field("campaign", "text", field.column), field.column)
        numbers = [campaigns.campaign_id(self._session, value.text) for value in values_of(part)]
        among = LoadStateRow.campaign_id.in_(numbers)
        unwanted = isinstance(part, Comparison) and part.operator is Operator.UNEQUAL
        return ~among if unwanted else among


def _asked(fields: StateFields, query: Query, columns: Sequence[str] | None) -> dict[str, StateField]:
    """Return what to show of each state, by column."""
    if columns is not None:
        asked = {name: fields.column(name) for name in columns}
        for name, one in asked.items():
            if one.by_view and one.statistic is None:
                raise InvalidInput(
                    f"views are listed for every state anyway; leave '{name}' out of the `columns`"
                )
        return asked
    tests = [test for test in comparisons(query.condition) if test.name.at != UNWRITTEN]
    compared = [one for one in map(fields.tested, tests) if not one.by_view or one.statistic is not None]
    loads = [one for one in compared if one.field.stored == "load_n"] or [fields.column("load_n")]
    first = [fields.column("campaign"), fields.column("state"), *loads, fields.column("time")]
    return {one.field.name: one for one in [*first, *compared]}


def _after(session: Session, number: int) -> ColumnElement[bool]:
    """Return whether a state comes after another one."""
    state = session.get(LoadStateRow, number)
    if state is None:
        raise NotFound(f"there is no state with number {number} to go on after; ask from the beginning")
    same = LoadStateRow.campaign_id == state.campaign_id
    later = or_(
        LoadStateRow.position > state.position,
        and_(LoadStateRow.position == state.position, LoadStateRow.id > state.id),
    )
    return or_(LoadStateRow.campaign_id < state.campaign_id, and_(same, later))


def _states(
    session: Session,
    ids: Sequence[int],
    asked: dict[str, StateField],
    dataset_type: str,
    conditions: _Conditions,
) -> Iterator[FoundState]:
    whole = {name: one.field for name, one in asked.items() if not one.by_view}
    extra = [field.column.label(f"value_{place}") for place, field in enumerate(whole.values())]
    by_view = {
        name: (one.statistic, one.field.factor)
        for name, one in asked.items()
        if one.statistic and one.by_view
    }
    for some in parts(ids):
        views: dict[int, dict[str, dict[str, float]]] = {}
        for name, (told, factor) in by_view.items():
            for key, view, value in session.execute(_told(told, some, dataset_type)):
                views.setdefault(key, {}).setdefault(view, {})[name] = value / factor
        met: dict[int, list[str]] = {}
        if conditions.about_views:
            seen: Select[Any, Any] = select(SEEN.state_id, SEEN.view)
            seen = seen.join(LoadStateRow, LoadStateRow.id == SEEN.state_id)
            seen = seen.where(LoadStateRow.id.in_(some), *conditions.of_views()).distinct()
            for key, view in session.execute(seen):
                met.setdefault(key, []).append(view)
        rows = session.execute(select(LoadStateRow.id, *extra).where(LoadStateRow.id.in_(some)))
        values = {row[0]: dict(zip(whole, row[1:], strict=True)) for row in rows}
        for key in some:
            told_of = {name: _in_unit(whole[name], value) for name, value in values[key].items()}
            by = tuple(sorted(met.get(key, ()), key=place_of_view)) if conditions.about_views else None
            of_views = views.get(key, {})
            in_order = {view: of_views[view] for view in sorted(of_views, key=place_of_view)}
            yield FoundState(key, told_of, in_order, by)


def _told(told: ResultStatistic, states: Sequence[int], dataset_type: str) -> Select[Any, Any, float]:
    """Select a statistic of the newest results of a kind, by state and view."""
    newest = (
        select(func.max(FileRow.id))
        .where(
            FileRow.source == told.kind,
            FileRow.state_id.in_(states),
            FileRow.view.is_not(None),
            FileRow.media_type == dataset_type,
        )
        .group_by(FileRow.state_id, FileRow.view)
    )
    return (
        select(FileRow.state_id, FileRow.view, StatisticRow.value)
        .join(StatisticRow, StatisticRow.file_id == FileRow.id)
        .where(StatisticRow.name == told.name, FileRow.id.in_(newest))
    )


def _in_unit(field: Field, value: Any) -> Value:
    return value / field.factor if field.factor != 1.0 and isinstance(value, int | float) else value
