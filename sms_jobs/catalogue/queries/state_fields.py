"""What the names of a query mean where it is asked about load states, not files.

Every field is one expression about a row of `load_state`. What results of views tell is one about `SEEN` as
well: any file of the state that has a view, and stands for it. The newest result of a kind counts, and the
newest recording of each view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from sqlalchemy import ColumnElement, Select, func, select
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from sms_jobs.catalogue.queries.fields import different, file_fields
from sms_jobs.catalogue.queries.language import A_COLUMN, Name, Query, Test, refuse
from sms_jobs.catalogue.queries.names import Field, Resolver, Type, built_in, listed, stored_name
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow, SpecimenRow
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow, ReadingRow, StatisticRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow

SEEN = aliased(FileRow, name="seen")


@dataclass(frozen=True)
class ResultStatistic:
    """A statistic of the results of a kind; `by_view` unless they are of states as a whole."""

    kind: str
    name: str
    by_view: bool


@dataclass(frozen=True)
class StateField:
    """Something that can be asked about a state; `told` by results where it is a statistic of theirs."""

    field: Field
    by_view: bool = False
    statistic: ResultStatistic | None = None


def _recordings() -> Select[int]:
    """Select the files of the newest recording of each view."""
    newest = select(func.max(MeasurementRow.file_id)).where(MeasurementRow.state_id == LoadStateRow.id)
    return newest.group_by(MeasurementRow.view).correlate(LoadStateRow)


def _read(name: str, entered: ColumnElement[Any]) -> ColumnElement[Any]:
    """Return the mean over the views of what a channel read, else what is known from elsewhere."""
    mean = select(func.avg(ReadingRow.value)).where(
        ReadingRow.name == name, ReadingRow.file_id.in_(_recordings())
    )
    return func.coalesce(mean.correlate(LoadStateRow).scalar_subquery(), entered)


def _time() -> ColumnElement[Any]:
    """Return when the last of the recordings was started, else when the state was held."""
    last = select(func.max(MeasurementRow.recorded_at)).where(MeasurementRow.file_id.in_(_recordings()))
    return func.coalesce(last.correlate(LoadStateRow).scalar_subquery(), LoadStateRow.time)


def _of_campaign(column: InstrumentedAttribute[Any]) -> ColumnElement[Any]:
    found = select(column).select_from(CampaignRow)
    found = found.join(SpecimenRow, SpecimenRow.id == CampaignRow.specimen_id)
    found = found.join(RigRow, RigRow.id == CampaignRow.rig_id)
    found = found.where(CampaignRow.id == LoadStateRow.campaign_id)
    return found.correlate(LoadStateRow).scalar_subquery()


@cache
def _built_in() -> dict[str, StateField]:
    of_state: tuple[tuple[str, Type, ColumnElement[Any]], ...] = (
        ("campaign", "campaign", _of_campaign(CampaignRow.name)),
        ("state", "text", LoadStateRow.label.expression),
        ("load_n", "number", _read("load_n", LoadStateRow.load_n.expression)),
        ("displacement_mm", "number", _read("displacement_mm", LoadStateRow.displacement_mm.expression)),
        ("planned_load_n", "number", LoadStateRow.planned_load_n.expression),
        ("planned_displacement_mm", "number", LoadStateRow.planned_displacement_mm.expression),
        ("time", "time", _time()),
        ("specimen", "text", _of_campaign(SpecimenRow.name)),
        ("frame", "text", _of_campaign(CampaignRow.frame)),
        ("rig", "text", _of_campaign(RigRow.name)),
    )
    of_view = (("view", SEEN.view), ("camera", SEEN.camera), ("projector", SEEN.projector))
    return {name: StateField(Field(name, type_, column, stored=name)) for name, type_, column in of_state} | {
        name: StateField(Field(name, "text", column.expression), by_view=True) for name, column in of_view
    }


def newest_results(told: ResultStatistic, dataset_type: str) -> Select[int]:
    """Select the newest result of a kind at a state, by that of `SEEN` where it is of views."""
    file = aliased(FileRow)
    found = select(func.max(file.id)).where(
        file.campaign_id == LoadStateRow.campaign_id,
        file.source == told.kind,
        file.state_id == LoadStateRow.id,
        file.view == SEEN.view if told.by_view else file.view.is_(None),
        file.media_type == dataset_type,
    )
    return found.correlate(LoadStateRow, SEEN)


class StateFields:
    """Finds what a name means in one catalogue.

    Parameters
    ----------
    query
        Whose names they are; if it asks for a kind, statistics are those of its results.
    dataset_type
        Media type of results, which have statistics; documents beside them have none.
    """

    def __init__(self, session: Session, query: Query, dataset_type: str) -> None:
        self._session = session
        self._query = query
        self._dataset_type = dataset_type
        self._found: dict[str, StateField] = {}
        self._told: dict[str, list[ResultStatistic]] = {}
        self._names: dict[str, tuple[str, ...]] = {}
        self._resolver = Resolver(self._look, self.names)

    def tested(self, part: Test) -> StateField:
        """Return what a test compares, in the unit of its values; raises as `Resolver.tested` does."""
        self._refuse_others(part.name, self._query.text)
        return self._of(self._resolver.tested(part, self._query.text))

    def column(self, name: str) -> StateField:
        """Return what a column is to tell; raises as `Resolver.field` does."""
        self._refuse_others(Name(name, A_COLUMN), name)
        return self._of(self._resolver.field(Name(name, A_COLUMN), name))

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds that files are of."""
        return self._distinct(FileRow.source)

    def is_by_view(self, kind: str) -> bool:
        """Return whether results of a kind are of views, not of states as a whole."""
        of_view = select(FileRow.id).where(FileRow.source == kind, FileRow.view.is_not(None)).limit(1)
        return self._session.scalar(of_view) is not None

    def names(self, space: str = "") -> list[str]:
        """Return all names, or those behind `statistic.`, `channel.` or a kind."""
        names = [] if space else list(_built_in())
        if space in ("", "channel"):
            names += [f"channel.{n}" for n in self._channels()]
        if space != "channel":
            names += [f"{space}.{n}".lstrip(".") for n in self._distinct(StatisticRow.name)]
        return names

    def _of(self, field: Field) -> StateField:
        # In another unit it is another field that tells the same.
        found = self._found.get(field.stored) or _built_in()[field.stored or field.name]
        return replace(found, field=field)

    def _refuse_others(self, name: Name, text: str) -> None:
        """Refuse what only files have, and what is said to be of no kind."""
        space, dot, _ = name.text.lower().partition(".")
        if (dot and space == "param") or (not dot and space in file_fields().keys() - _built_in().keys()):
            refuse(text, name.at, f"'{name.text}' is of files: ask 'sms data find' for it")
        spaces = ("statistic", "channel", *self.kinds())
        if dot and space not in spaces:
            refuse(text, name.at, f"'{space}.' has no meaning; there are {listed(f'{s}.' for s in spaces)}")

    def _look(self, name: str) -> Field | list[str]:
        space, dot, rest = name.partition(".")
        space = space.lower()
        if dot:
            if space == "channel":
                return self._channel(rest, name)
            return self._statistic(rest, name, "" if space == "statistic" else space)
        own = built_in(name, [one.field for one in _built_in().values()])
        if own is not None:
            return own
        # A name in full comes before the beginning of another: temp_c is not temp_c_before.
        for whole in (True, False):
            found = self._statistic(name, name, "", whole) or self._channel(name, name, whole)
            if found:
                return found
        return []

    def _channel(self, name: str, written: str, whole: bool = False) -> Field | list[str]:
        found = stored_name(name, self._channels(), whole)
        if isinstance(found, list):
            return found
        stored, factor = found
        entered = select(ChannelRow.value).where(
            ChannelRow.state_id == LoadStateRow.id, ChannelRow.name == stored
        )
        value = _read(stored, entered.correlate(LoadStateRow).scalar_subquery())
        field = Field(written, "number", value, factor, stored=f"channel.{stored}")
        self._found[field.stored] = StateField(field)
        return field

    def _statistic(self, name: str, written: str, kind: str, whole: bool = False) -> Field | list[str]:
        """Return a statistic that one kind tells, or the names of all that may be meant."""
        if not kind and self._query.kind is not None:
            kind = self._query.kind.text
        found = stored_name(name, self._distinct(StatisticRow.name), whole)
        stored, factor = ([found[0]], found[1]) if isinstance(found, tuple) else (found, 1.0)
        told = [one for n in stored for one in self._told_by(n) if kind in ("", one.kind)]
        if len(told) != 1:
            return [f"{one.kind}.{one.name}" for one in told]
        (only,) = told
        newest = newest_results(only, self._dataset_type).scalar_subquery()
        value = select(StatisticRow.value).where(
            StatisticRow.name == only.name, StatisticRow.file_id == newest
        )
        column = value.correlate(LoadStateRow, SEEN).scalar_subquery()
        field = Field(written, "number", column, factor, stored=f"{only.kind}.{only.name}")
        self._found[field.stored] = StateField(field, only.by_view, only)
        return field

    def _told_by(self, name: str) -> list[ResultStatistic]:
        """Return the kinds whose results about states tell a statistic."""
        if name not in self._told:
            rows = self._session.execute(
                select(FileRow.source, FileRow.view.is_not(None))
                .join(StatisticRow, StatisticRow.file_id == FileRow.id)
                .where(StatisticRow.name == name, FileRow.state_id.is_not(None))
                .distinct()
            )
            self._told[name] = sorted(
                (ResultStatistic(kind, name, bool(by)) for kind, by in rows), key=lambda t: t.kind
            )
        return self._told[name]

    def _channels(self) -> Sequence[str]:
        return tuple(sorted({*self._distinct(ReadingRow.name), *self._distinct(ChannelRow.name)}))

    def _distinct(self, column: InstrumentedAttribute[str]) -> tuple[str, ...]:
        key = str(column)
        if key not in self._names:
            self._names[key] = tuple(sorted(self._session.scalars(different(column))))
        return self._names[key]
