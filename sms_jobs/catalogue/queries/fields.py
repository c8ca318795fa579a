"""What the names of a query mean: columns, readings, statistics and parameters, and the indexes they have.

Every field is one expression about a row of `file`. What lies in another table is a subquery that finds one
row by its key: no database can make more of it than that one look-up, so that the cost of a query is the
number of files that are looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, cached_property
from typing import Any, Literal

from sqlalchemy import ColumnElement, Select, String, case, cast, func, literal, select
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from sms_jobs.catalogue.queries.language import Name, Test, refuse
from sms_jobs.catalogue.queries.names import Field, Resolver, Source, Type, built_in, listed, stored_name
from sms_jobs.catalogue.tables.calibrations import CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow, SpecimenRow
from sms_jobs.catalogue.tables.files import FileRow, ReadingRow, ResultRow, StatisticRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow
from sms_jobs.errors import did_you_mean


class Vocabulary:
    """What the program knows besides the catalogue: its kinds, and the parameters of their jobs.

    Parameters
    ----------
    learn
        Returns both. It is asked once, and not before a query has a word that the catalogue does not know:
        for the program itself it means to load every kind.
    """

    def __init__(self, learn: Callable[[], tuple[frozenset[str], frozenset[str]]]) -> None:
        self._learn = learn

    @cached_property
    def _learnt(self) -> tuple[frozenset[str], frozenset[str]]:
        return self._learn()

    @property
    def kinds(self) -> frozenset[str]:
        """Return the kinds that files may be of."""
        return self._learnt[0]

    @property
    def parameters(self) -> frozenset[str]:
        """Return the names of all parameters."""
        return self._learnt[1]


def _of(key: ColumnElement[bool], column: InstrumentedAttribute[Any]) -> ColumnElement[Any]:
    return select(column).where(key).correlate(FileRow).scalar_subquery()


def _of_state(column: InstrumentedAttribute[Any]) -> ColumnElement[Any]:
    return _of(LoadStateRow.id == FileRow.state_id, column)


def _state(name: str, column: InstrumentedAttribute[Any], type_: Type) -> Field:
    return Field(name, type_, _of_state(column), of_state=column.expression)


def _held(column: InstrumentedAttribute[Any]) -> Source:
    """Return the files of states, by a column of these."""
    files = select(FileRow.id).join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
    return Source(files, column.expression)


def _reading(name: str) -> tuple[ColumnElement[Any], Source]:
    """Return what a channel read while a file was recorded, and the files that have such a reading."""
    value = _of((ReadingRow.file_id == FileRow.id) & (ReadingRow.name == name), ReadingRow.value)
    files = select(ReadingRow.file_id).where(ReadingRow.name == name)
    return value, Source(files, ReadingRow.value.expression)


def _read(name: str, entered: InstrumentedAttribute[Any]) -> Field:
    """Return what was read while a file was recorded, else what is known of its state."""
    value, source = _reading(name)
    value = func.coalesce(value, _of_state(entered))
    return Field(name, "number", value, sources=(source, _held(entered)))


def _time() -> Field:
    """Return when a file was recorded, else when its state was held."""
    value = func.coalesce(FileRow.recorded_at, _of_state(LoadStateRow.time))
    recorded = Source(select(FileRow.id), FileRow.recorded_at.expression)
    return Field("time", "time", value, sources=(recorded, _held(LoadStateRow.time)))


def _rig() -> ColumnElement[Any]:
    campaign, calibration = aliased(CampaignRow), aliased(CalibrationRow)
    used = select(RigRow.name).join(campaign, campaign.rig_id == RigRow.id)
    made = select(RigRow.name).join(calibration, calibration.rig_id == RigRow.id)
    return func.coalesce(
        used.where(campaign.id == FileRow.campaign_id).correlate(FileRow).scalar_subquery(),
        made.where(calibration.file_id == FileRow.id).correlate(FileRow).scalar_subquery(),
    )


def _calibrations() -> ColumnElement[Any]:
    """Return the numbers of the calibrations that a file was computed with, with commas between."""
    numbers = func.aggregate_strings(cast(CalibrationUseRow.calibration_id, String), ",")
    used = select(numbers).where(CalibrationUseRow.file_id == FileRow.id)
    return used.correlate(FileRow).scalar_subquery()


def _specimen() -> ColumnElement[Any]:
    tested = select(SpecimenRow.name).join(CampaignRow, CampaignRow.specimen_id == SpecimenRow.id)
    return tested.where(CampaignRow.id == FileRow.campaign_id).correlate(FileRow).scalar_subquery()


@cache
def file_fields() -> dict[str, Field]:
    """Return what every catalogue knows of a file, by name."""
    campaign = _of(CampaignRow.id == FileRow.campaign_id, CampaignRow.name)
    version = _of(ResultRow.file_id == FileRow.id, ResultRow.kind_version)
    created = Source(select(FileRow.id), FileRow.created_at.expression)
    fields = (
        Field("file", "number", FileRow.id.expression),
        Field("kind", "text", FileRow.source.expression),
        Field("campaign", "campaign", campaign),
        _state("state", LoadStateRow.label, "text"),
        Field("view", "text", FileRow.view.expression),
        Field("camera", "text", FileRow.camera.expression),
        Field("projector", "text", FileRow.projector.expression),
        _read("load_n", LoadStateRow.load_n),
        _read("displacement_mm", LoadStateRow.displacement_mm),
        _state("planned_load_n", LoadStateRow.planned_load_n, "number"),
        _state("planned_displacement_mm", LoadStateRow.planned_displacement_mm, "number"),
        _time(),
        Field("created", "time", FileRow.created_at.expression, sources=(created,)),
        Field("calibration", "calibration", _calibrations()),
        Field("version", "number", version),
        Field("rig", "text", _rig()),
        Field("specimen", "text", _specimen()),
        Field("frame", "text", _of(CampaignRow.id == FileRow.campaign_id, CampaignRow.frame)),
        Field("job", "prefix", FileRow.job_id.expression),
        Field("path", "text", FileRow.path.expression),
        Field("size_bytes", "number", FileRow.size_bytes.expression),
    )
    return {field.name: replace(field, stored=field.name) for field in fields}


_SPACES = ("statistic", "channel", "param")


class Fields:
    """Finds what a name means in one catalogue."""

    def __init__(self, session: Session, vocabulary: Vocabulary) -> None:
        self._session = session
        self._vocabulary = vocabulary
        self._built_in = file_fields()
        self._names: dict[str, tuple[str, ...]] = {}
        self._resolver = Resolver(self._look, self.names)

    def field(self, name: Name, text: str) -> Field:
        """Return what a name of a query means; raises as `Resolver.field` does."""
        self._refuse_unknown_space(name, text)
        return self._resolver.field(name, text)

    def tested(self, part: Test, text: str) -> Field:
        """Return what a test compares, in the unit of its values; raises as `Resolver.tested` does."""
        self._refuse_unknown_space(part.name, text)
        return self._resolver.tested(part, text)

    def _refuse_unknown_space(self, name: Name, text: str) -> None:
        space, dot, _ = name.text.partition(".")
        if dot and space.lower() not in _SPACES:
            refuse(text, name.at, f"'{space}.' has no meaning; there are {listed(f'{s}.' for s in _SPACES)}")

    def _look(self, name: str) -> Field | list[str]:
        space, dot, rest = name.partition(".")
        if not dot:
            return self._plain(name)
        look_up = {"statistic": self._statistic, "channel": self._channel, "param": self._parameter}
        return look_up[space.lower()](rest, name)

    def refuse_unknown_kind(self, kind: Name, text: str) -> None:
        """Raise `InvalidInput` where no file is, and none can become, of that kind."""
        there = set(self._distinct(FileRow.source))
        if kind.text in there or kind.text in self._vocabulary.kinds:
            return
        kinds = sorted(self._vocabulary.kinds | there)
        meant = did_you_mean(kind.text, kinds, 0.5)
        refuse(text, kind.at, f"there is no kind '{kind.text}'; {meant}there are {listed(kinds)}")

    def names(self, space: str = "") -> list[str]:
        """Return all names, or those behind `statistic.`, `channel.` or `param.`."""
        names = [] if space else list(self._built_in)
        if space in ("", "statistic"):
            names += [f"{space}.{n}".lstrip(".") for n in self._distinct(StatisticRow.name)]
        if space in ("", "channel"):
            names += [f"channel.{n}" for n in self._channels()]
        if space in ("", "param"):
            names += [f"param.{n}" for n in sorted(self._vocabulary.parameters)]
        return names

    def _plain(self, name: str) -> Field | list[str]:
        own = built_in(name, self._built_in.values())
        if own is not None:
            return own
        # A name in full comes before the beginning of another: temp_c is not temp_c_before.
        for whole in (True, False):
            found = self._statistic(name, name, whole) or self._channel(name, name, whole)
            if found:
                return found
        return []

    def _statistic(self, name: str, written: str, whole: bool = False) -> Field | list[str]:
        def made(stored: str, factor: float) -> Field:
            value = _of(
                (StatisticRow.file_id == FileRow.id) & (StatisticRow.name == stored), StatisticRow.value
            )
            rows = select(StatisticRow.file_id).where(StatisticRow.name == stored)
            source = Source(rows, StatisticRow.value.expression)
            return Field(written, "number", value, factor, (source,), stored=stored)

        return self._stored(name, self._distinct(StatisticRow.name), made, whole)

    def _channel(self, name: str, written: str, whole: bool = False) -> Field | list[str]:
        def made(stored: str, factor: float) -> Field:
            read, recorded = _reading(stored)
            value = _of(
                (ChannelRow.state_id == FileRow.state_id) & (ChannelRow.name == stored), ChannelRow.value
            )
            rows = select(FileRow.id).join(ChannelRow, ChannelRow.state_id == FileRow.state_id)
            entered = Source(rows.where(ChannelRow.name == stored), ChannelRow.value.expression)
            value = func.coalesce(read, value)
            return Field(written, "number", value, factor, (recorded, entered), stored=stored)

        return self._stored(name, self._channels(), made, whole)

    def _channels(self) -> tuple[str, ...]:
        """Return the names of what was recorded with measurements or entered for states."""
        return tuple(sorted({*self._distinct(ReadingRow.name), *self._distinct(ChannelRow.name)}))

    def _parameter(self, name: str, written: str) -> Field | list[str]:
        def made(stored: str, factor: float) -> Field:
            value = _of(JobRow.id == FileRow.job_id, JobRow.parameters)
            return Field(written, "parameter", value, factor, stored=stored)

        return self._stored(name, tuple(sorted(self._vocabulary.parameters)), made)

    def _stored(
        self, name: str, stored: tuple[str, ...], made: Callable[[str, float], Field], whole: bool = False
    ) -> Field | list[str]:
        found = stored_name(name, stored, whole)
        return found if isinstance(found, list) else made(*found)

    def _distinct(self, column: InstrumentedAttribute[str]) -> tuple[str, ...]:
        """Return the different values of an indexed column."""
        key = str(column)
        if key not in self._names:
            self._names[key] = tuple(sorted(self._session.scalars(different(column))))
        return self._names[key]


@cache
def different(column: InstrumentedAttribute[str]) -> Select[str]:
    """Select the different values of an indexed column: one look into the index for each."""
    seen = select(func.min(column).label("name")).cte("seen", recursive=True)
    other = aliased(column.class_)
    own = getattr(other, column.key)
    later = select(func.min(own)).where(own > seen.c.name).correlate(seen).scalar_subquery()
    seen = seen.union_all(select(later).where(seen.c.name.is_not(None)))
    return select(seen.c.name).where(seen.c.name.is_not(None))


def parameter_as(kept: Field, type_: Literal["number", "text", "truth"], dialect: str) -> ColumnElement[Any]:
    """Return a parameter of the job that made a file, None where it is of another type."""
    document = JobRow.parameters
    value = document[kept.stored]
    if dialect == "sqlite":
        sort = func.json_type(document, literal(f'$."{kept.stored}"', String))
    else:
        sort = func.json_typeof(value)
    sorts: Mapping[str, tuple[tuple[str, ...], ColumnElement[Any]]] = {
        "number": (("integer", "real", "number"), value.as_float()),
        "text": (("text", "string"), value.as_string()),
        "truth": (("true", "false", "boolean"), value.as_boolean()),
    }
    names, typed = sorts[type_]
    # Reading a text as a number would be an error on PostgreSQL.
    chosen = case((sort.in_(names), typed), else_=None)
    return select(chosen).where(JobRow.id == FileRow.job_id).correlate(FileRow).scalar_subquery()
