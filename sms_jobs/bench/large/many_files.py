"""A catalogue with any number of files, made by the database itself, and the questions asked of it.

Tuples of four files each (measurement, reconstruct, correlate, strain) with a job and statistics, 4 views a
state, 100 states a campaign, 5 campaigns a calibration. At odd states load and temperature were recorded with
the measurement. Values scatter by multiplication modulo a prime.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Double,
    String,
    case,
    cast,
    insert,
    literal,
    select,
)
from sqlalchemy.orm import Session

from sms_jobs.catalogue import copying, job_counts, upkeep
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.base import BigId, JobStateColumn, Table
from sms_jobs.catalogue.tables.calibrations import CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow, SpecimenRow
from sms_jobs.catalogue.tables.columns import UtcDateTime
from sms_jobs.catalogue.tables.files import (
    FileRow,
    MeasurementRow,
    ProvenanceRow,
    ReadingRow,
    ResultRow,
    StatisticRow,
)
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow
from sms_jobs.records.job import JobState
from sms_jobs.records.views import view_of

KINDS = ("measurement", "reconstruct", "correlate", "strain")
VIEWS = ("C1P1", "C1P2", "C2P1", "C2P2")
STATES = 100
"""In a campaign."""
CAMPAIGNS = 5
"""With one calibration."""
BEGUN = datetime(2020, 1, 1, tzinfo=UTC)
RIG = "rig"
"""Of all campaigns."""
PARAMETERS = frozenset({"gauge_length_mm", "method"})

_STATE = len(KINDS) * len(VIEWS)
_CAMPAIGN = _STATE * STATES
_MOMENTS = 40
_CALIBRATIONS = 10_000
"""Numbers of files below this are those of calibrations."""
_STATISTICS: Mapping[str, Mapping[str, float]] = {
    "measurement": {"saturated_fraction": 0.1, "mean_level_count": 4095.0},
    "reconstruct": {"valid_fraction": 1.0, "median_sigma_mm": 0.05, "ray_gap_rms_mm": 0.1},
    "correlate": {"valid_fraction": 1.0, "median_sigma_mm": 0.05, "maximum_displacement_mm": 20.0},
    "strain": {"valid_fraction": 1.0, "maximum_principal_strain": 2e-3, "median_von_mises_strain": 1e-3},
}
"""Statistics of a kind, and the greatest value of each."""

DOCUMENTED = (
    "strain where load_kN > 1400 and max_principal > 1e-3 and calibration = 3",
    "measurement where campaign = c00007 and state in (S01, S02) and time >= 2020-05-01",
    "strain where max_principal > 1999.9e-6",
    "strain where maximum_principal_microstrain between 1500 and 1600 and view = C1P2",
    "reconstruct where median_sigma_um > 49.99 or valid_fraction < 0.0001",
    "measurement where channel.temp_c > 30 and camera = C2",
    "strain where param.gauge_length_mm = 30 and not valid_fraction < 0.5",
    "where created >= 2020-01-02 and version = 2",
    "correlate where campaign = c00003 and maximum_displacement_mm > 19",
    "reconstruct where time >= 2020-07-01 and load_n > 1999000",
    "strain where planned_load_MN > 1.999 and temp_c > 20",
)
"""The questions of `docs/query.md`, with names of this catalogue."""


def _scatter(n: ColumnElement[Any], salt: int, greatest: float) -> ColumnElement[Any]:
    """Return numbers between 0 and `greatest` that look like chance."""
    prime = 1_000_003
    return cast((n * (7919 + 104_729 * salt)) % prime, Double) * literal(greatest / prime, Double)


def _numbers(first: int, last: int) -> ColumnElement[int]:
    counted = select(cast(literal(first), BigId).label("n")).cte("counted", recursive=True)
    counted = counted.union_all(select(counted.c.n + 1).where(counted.c.n < last))
    return counted.c.n


class _Filling:
    """Inserts that select what they insert from a row of numbers."""

    def __init__(self, session: Session, first: int, last: int) -> None:
        self._session = session
        self._first, self._last = first, last

    def rows(
        self,
        table: type[Table],
        columns: Callable[[ColumnElement[int]], Mapping[str, Any]],
        where: Callable[[ColumnElement[int]], ColumnElement[bool]] | None = None,
    ) -> None:
        n = _numbers(self._first, self._last)
        values = {
            name: value if isinstance(value, ColumnElement) else literal(value, getattr(table, name).type)
            for name, value in columns(n).items()
        }
        query = select(*values.values())
        if where is not None:
            query = query.where(where(n))
        self._session.execute(insert(table).from_select(list(values), query))


def fill(catalogue: Catalogue, files: int, say: Callable[[str], None] = lambda text: None) -> None:
    """Fill an empty catalogue with so many files, and let the database look at them (ANALYZE)."""
    campaigns = -(-files // _CAMPAIGN)
    calibrations = -(-campaigns // CAMPAIGNS)
    with catalogue.writing() as session:
        _rows_above(session, campaigns, calibrations)
        _states(_Filling(session, 0, campaigns * STATES - 1))
    at_once = 200_000
    for first in range(0, files, at_once):
        with catalogue.writing() as session:
            part = _Filling(session, first, min(files, first + at_once) - 1)
            _jobs(part)
            _files(part)
            _readings(part)
            _facts(part)
        say(f"filled {min(files, first + at_once)} files")
    with catalogue.writing() as session:
        _note_calibrations(session)
        if catalogue.dialect == "postgresql":
            copying.set_sequences(session)
    job_counts.fold(catalogue)
    upkeep.analyse(catalogue)


def _rows_above(session: Session, campaigns: int, calibrations: int) -> None:
    session.add(RigRow(id=1, name=RIG))
    session.add(SpecimenRow(id=1, name="specimen", material="", description=""))
    session.flush()
    for key in range(1, calibrations + 1):
        session.add(
            FileRow(
                id=key,
                source="calibration",
                path=f"calibrations/{key}.h5",
                content_hash=f"{key:064x}",
                size_bytes=10_000,
                media_type="application/x-hdf5",
                created_at=BEGUN,
            )
        )
        session.flush()
        session.add(CalibrationRow(id=key, rig_id=1, file_id=key, valid_from=BEGUN, origin="", sensors={}))
    for key in range(1, campaigns + 1):
        at = BEGUN + timedelta(hours=key)
        name = f"c{key - 1:05d}"
        session.add(
            CampaignRow(
                id=key,
                name=name,
                specimen_id=1,
                rig_id=1,
                created_at=at,
                definition={},
                definition_hash="",
                views=list(VIEWS),
            )
        )


def _at(n: ColumnElement[int], each: int) -> ColumnElement[Any]:
    """Return times, five days later for each so many numbers."""
    moments = [BEGUN + timedelta(days=5 * k) for k in range(_MOMENTS)]
    return case(
        *((n // each == k, literal(at, UtcDateTime())) for k, at in enumerate(moments[:-1])),
        else_=literal(moments[-1], UtcDateTime()),
    )


def _states(states: _Filling) -> None:
    states.rows(
        LoadStateRow,
        lambda n: {
            "id": n + 1,
            "campaign_id": n // STATES + 1,
            "label": _joined("S", _padded(n % STATES)),
            "position": n % STATES,
            "load_n": _scatter(n, 1, 2e6),
            "planned_load_n": _scatter(n, 1, 2e6),
            "time": _at(n, 25_000 // _STATE),
        },
    )
    states.rows(ChannelRow, lambda n: {"state_id": n + 1, "name": "temp_c", "value": _scatter(n, 2, 40.0)})


def _chosen(n: ColumnElement[int], values: tuple[str, ...]) -> ColumnElement[Any]:
    return case(
        *((n % len(values) == k, literal(v, String)) for k, v in enumerate(values[:-1])),
        else_=literal(values[-1], String),
    )


def _job(n: ColumnElement[int]) -> ColumnElement[Any]:
    return _joined("j", cast(n, String))


def _is_kind(kind: str) -> Callable[[ColumnElement[int]], ColumnElement[bool]]:
    return lambda n: n % len(KINDS) == KINDS.index(kind)


def _computed(n: ColumnElement[int]) -> ColumnElement[bool]:
    return n % len(KINDS) != 0


def _jobs(files: _Filling) -> None:
    files.rows(
        JobRow,
        lambda n: {
            "id": _job(n),
            "kind": _chosen(n, KINDS),
            "kind_version": 2,
            "campaign_id": n // _CAMPAIGN + 1,
            "subject": _joined("s/", cast(n, String)),
            "parameters": case(
                (n % 3 == 0, literal({"gauge_length_mm": 30.0, "method": "fdr"}, JobRow.parameters.type)),
                else_=literal({"gauge_length_mm": 20.0, "method": "linear"}, JobRow.parameters.type),
            ),
            "queue": "cpu",
            "priority": 0,
            "position": n,
            "repeatable": True,
            "use_cache": True,
            "state": literal(JobState.SUCCEEDED, JobStateColumn),
            "submitted_at": BEGUN,
            "attempts": 1,
            "crashes": 0,
            "fence": 1,
            "progress": 1.0,
            "message": "",
        },
    )


def _files(files: _Filling) -> None:
    files.rows(
        FileRow,
        lambda n: {
            "id": n + _CALIBRATIONS,
            "source": _chosen(n, KINDS),
            "path": _joined("campaigns/files/", cast(n, String)),
            "content_hash": _joined("0" * 50, cast(n, String)),
            "size_bytes": n % 100_000_000,
            "media_type": "application/x-hdf5",
            "created_at": _at(n, 25_000),
            "recorded_at": _at(n - n % len(KINDS), 25_000),
            "campaign_id": n // _CAMPAIGN + 1,
            "state_id": n // _STATE + 1,
            "view": _chosen(n // len(KINDS), VIEWS),
            "camera": _chosen(n // len(KINDS), tuple(view_of(v).camera for v in VIEWS)),
            "projector": _chosen(n // len(KINDS), tuple(view_of(v).projector for v in VIEWS)),
            "job_id": _job(n),
        },
    )
    files.rows(
        MeasurementRow,
        lambda n: {
            "file_id": n + _CALIBRATIONS,
            "state_id": n // _STATE + 1,
            "view": _chosen(n // len(KINDS), VIEWS),
            "recorded_at": _at(n, 25_000),
        },
        _is_kind("measurement"),
    )
    files.rows(
        ResultRow,
        lambda n: {"file_id": n + _CALIBRATIONS, "kind": _chosen(n, KINDS), "kind_version": 2},
        _computed,
    )


def _readings(files: _Filling) -> None:
    """Enter what was read at odd states, a little off what is planned for them."""
    for salt, name, greatest in ((1, "load_n", 2e6), (2, "temp_c", 40.0)):
        files.rows(
            ReadingRow,
            lambda n, name=name, salt=salt, greatest=greatest: {  # type: ignore[misc]
                "file_id": n + _CALIBRATIONS,
                "name": name,
                "value": _scatter(n // _STATE, salt, greatest) + literal(1.0, Double),
            },
            lambda n: (n // _STATE) % 2 == 1,
        )


def _facts(files: _Filling) -> None:
    for kind, greatest in _STATISTICS.items():
        for place, (name, most) in enumerate(greatest.items()):
            files.rows(
                StatisticRow,
                lambda n, name=name, most=most, place=place: {  # type: ignore[misc]
                    "file_id": n + _CALIBRATIONS,
                    "name": name,
                    "value": _scatter(n, 3 + place, most),
                },
                _is_kind(kind),
            )
    # The shape of a state is computed with a calibration; everything else from what comes before it.
    files.rows(
        ProvenanceRow,
        lambda n: {"output_id": n + _CALIBRATIONS, "role": "input", "input_id": n + _CALIBRATIONS - 1},
        _computed,
    )
    files.rows(
        ProvenanceRow,
        lambda n: {
            "output_id": n + _CALIBRATIONS,
            "role": "calibration",
            "input_id": n // (_CAMPAIGN * CAMPAIGNS) + 1,
        },
        _is_kind("reconstruct"),
    )


def _padded(n: ColumnElement[int]) -> ColumnElement[Any]:
    return case((n < 10, _joined("0", cast(n, String))), else_=cast(n, String))


def _joined(first: str, rest: ColumnElement[Any]) -> ColumnElement[Any]:
    return literal(first, String).concat(rest)


def _note_calibrations(session: Session) -> None:
    """Enter for every file with which calibrations it was computed, from the whole provenance at once."""
    session.flush()
    used = (
        select(CalibrationRow.id.label("calibration_id"), ProvenanceRow.output_id.label("file_id"))
        .join(ProvenanceRow, ProvenanceRow.input_id == CalibrationRow.file_id)
        .cte("used", recursive=True)
    )
    used = used.union(
        select(used.c.calibration_id, ProvenanceRow.output_id).join(
            ProvenanceRow, ProvenanceRow.input_id == used.c.file_id
        )
    )
    columns = ["calibration_id", "file_id"]
    session.execute(
        insert(CalibrationUseRow).from_select(columns, select(*(used.c[name] for name in columns)))
    )
