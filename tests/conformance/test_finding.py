"""`data find`: the same answers from both databases, by pages, and never by looking at everything."""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from pyarrow import parquet
from sqlalchemy import event, select
from support.homes import make_home
from support.jobs import NOW

from sms_jobs import bootstrap
from sms_jobs.app.row_tables import write_parquet
from sms_jobs.bench.large import many_files
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.queries import files as query_files
from sms_jobs.catalogue.queries import saved
from sms_jobs.catalogue.queries.fields import Vocabulary
from sms_jobs.catalogue.queries.files import find_page, restricted
from sms_jobs.catalogue.queries.language import parse
from sms_jobs.catalogue.tables.calibrations import CalibrationRow, CalibrationUseRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, ReadingRow, StatisticRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow
from sms_jobs.cli.app import app
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError
from sms_jobs.records.shown.files import Page
from sms_jobs.records.shown.portion import Portion
from sms_jobs.records.times import UNTIMED

KINDS = frozenset({*many_files.KINDS, "calibration", "report"})
KNOWN = Vocabulary(lambda: (KINDS, many_files.PARAMETERS))
LARGE = {"file", "statistic", "reading", "job", "measurement", "result", "calibration_use", "provenance"}


def ask(catalogue: Catalogue, text: str, **more: Any) -> Page:
    with catalogue.reading() as session:
        return find_page(session, parse(text), KNOWN, Portion(**more))


@dataclass(frozen=True)
class Plain:
    """A file with all that is known of it in one place, for a reference that does without indexes."""

    id: int
    kind: str
    view: str
    campaign: str
    state: str
    load_n: float
    planned_load_n: float
    temp_c: float
    created: datetime
    recorded: datetime | None
    statistics: dict[str, float]


def everything(catalogue: Catalogue) -> list[Plain]:
    with catalogue.reading() as session:
        numbers: dict[int, dict[str, float]] = {}
        for key, name, value in session.execute(
            select(StatisticRow.file_id, StatisticRow.name, StatisticRow.value)
        ):
            numbers.setdefault(key, {})[name] = value
        rows = session.execute(
            select(FileRow, CampaignRow.name, LoadStateRow.label, LoadStateRow.load_n, ChannelRow.value)
            .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
            .join(LoadStateRow, LoadStateRow.id == FileRow.state_id)
            .join(ChannelRow, ChannelRow.state_id == FileRow.state_id)
        ).all()
        read: dict[int, dict[str, float]] = {}
        for key, name, value in session.execute(
            select(ReadingRow.file_id, ReadingRow.name, ReadingRow.value)
        ):
            read.setdefault(key, {})[name] = value
        return [
            Plain(
                file.id,
                file.source,
                file.view or "",
                campaign,
                state,
                read.get(file.id, {}).get("load_n", load or 0.0),
                load or 0.0,
                read.get(file.id, {}).get("temp_c", temp),
                file.created_at,
                file.recorded_at,
                numbers.get(file.id, {}),
            )
            for file, campaign, state, load, temp in rows
        ]


def number(file: Plain, name: str) -> float:
    """Return a statistic; NaN, of which no comparison is true, where there is none."""
    return file.statistics.get(name, float("nan"))


def loaded(file: Plain) -> bool:
    return 1e6 <= file.load_n <= 1.2e6 or file.planned_load_n > 1.999e6


def since(file: Plain, text: str) -> bool:
    return file.recorded is not None and file.recorded >= datetime.fromisoformat(text)


QUESTIONS: list[tuple[str, Callable[[Plain], bool]]] = [
    ("strain", lambda f: f.kind == "strain"),
    ("strain where load_kN > 1400", lambda f: f.kind == "strain" and f.load_n > 1.4e6),
    ("where load_MN <= 0.2 and view = C1P2", lambda f: f.load_n <= 2e5 and f.view == "C1P2"),
    (
        "where max_principal > 1e-3 or maximum_displacement_mm between 3 and 4",
        lambda f: (
            number(f, "maximum_principal_strain") > 1e-3 or 3.0 <= number(f, "maximum_displacement_mm") <= 4.0
        ),
    ),
    # What has no such statistic is neither below nor not below.
    ("not valid_fraction < 0.5", lambda f: number(f, "valid_fraction") >= 0.5),
    (
        "not (valid_fraction < 0.5 and view = C1P1)",
        lambda f: number(f, "valid_fraction") >= 0.5 or f.view != "C1P1",
    ),
    ("where state in (S01, S02) and camera = C2", lambda f: f.state in ("S01", "S02") and f.view[:2] == "C2"),
    ("where projector != P1 and state ~ s1", lambda f: f.view[2:] == "P2" and "S1" in f.state),
    ("where channel.temp_c > 30 and temp_c < 31", lambda f: 30.0 < f.temp_c < 31.0),
    ("median_sigma_um < 1", lambda f: number(f, "median_sigma_mm") < 1e-3),
    (
        "campaign in (c00000, c00001) and kind = correlate",
        lambda f: f.campaign < "c00002" and f.kind == "correlate",
    ),
    (
        "campaign ~ 01 and median_von_mises_microstrain >= 990",
        lambda f: "01" in f.campaign and number(f, "median_von_mises_strain") >= 990e-6,
    ),
    ("campaign != c00000 and load_n < 50000", lambda f: f.campaign != "c00000" and f.load_n < 5e4),
    ("file between 10100 and 10110", lambda f: 10100 <= f.id <= 10110),
    # The calibrations of 5 campaigns each, and what has no calibration: measurements.
    ("calibration = 1 and state = S05", lambda f: f.kind != "measurement" and f.state == "S05"),
    ("calibration != 1 and state = S05", lambda f: f.kind == "measurement" and f.state == "S05"),
    ("param.gauge_length_mm = 30 and state = S07", lambda f: (f.id - 10000) % 3 == 0 and f.state == "S07"),
    ("param.gauge_length_m = 0.02 and state = S07", lambda f: (f.id - 10000) % 3 != 0 and f.state == "S07"),
    ("param.method = fdr and state = S07", lambda f: (f.id - 10000) % 3 == 0 and f.state == "S07"),
    ("param.method = 3 or param.method = true", lambda f: False),
    ("version = 2 and state = S99", lambda f: f.kind != "measurement" and f.state == "S99"),
    ("rig = rig and specimen ~ PECI and state = S00", lambda f: f.state == "S00"),
    ("job = j10 and size_kb < 1", lambda f: str(f.id - 10000).startswith("10") and f.id - 10000 < 1000),
    ("created < 2020-01-01 or path = nowhere", lambda f: False),
    ("load_n < 5e4 and planned_load_n < 5e4", lambda f: max(f.load_n, f.planned_load_n) < 5e4),
    ("load_n between 1e6 and 1.2e6 or planned_load_kN > 1999", lambda f: loaded(f)),
    (
        "reconstruct where time >= 2020-01-06T00:00Z and load_MN > 1.5",
        lambda f: f.kind == "reconstruct" and f.load_n > 1.5e6 and since(f, "2020-01-06T00:00Z"),
    ),
    (
        "time < 2020-01-06T00:00Z and temp_c < 3",
        lambda f: f.temp_c < 3.0 and not since(f, "2020-01-06T00:00Z"),
    ),
    ("channel.load_kN > 1900 and state = S41", lambda f: f.load_n > 1.9e6 and f.state == "S41"),
    ("load > 1.9 MN and state = S41", lambda f: f.load_n > 1.9e6 and f.state == "S41"),
    ("load_n between 100 and 200 kN", lambda f: 1e5 <= f.load_n <= 2e5),
    ("median_sigma < 1 um", lambda f: number(f, "median_sigma_mm") < 1e-3),
    ("median_von_mises > 990 microstrain", lambda f: number(f, "median_von_mises_strain") > 990e-6),
    ("param.gauge_length = 3 cm and state = S07", lambda f: (f.id - 10000) % 3 == 0 and f.state == "S07"),
]


def test_the_answers_are_those_of_looking_at_every_file(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    many_files.fill(catalogue, 3200)
    files = everything(catalogue)
    assert len(files) == 3200
    for few in (query_files.FEW, -1):  # with the indexes of what is asked, and along that of all files
        monkeypatch.setattr(query_files, "FEW", few)
        for text, meets in QUESTIONS:
            expected = sorted((f.id for f in files if meets(f)), reverse=True)
            page = ask(catalogue, text, limit=5000)
            assert [one.file.id for one in page.rows] == expected, text
            assert page.next is None
    asked = ask(catalogue, "strain where load_kN > 1400 and param.method = fdr", limit=1).rows[0]
    plain = next(f for f in files if f.id == asked.file.id)
    # The value in the unit of the question, and back: a rounding or two.
    assert asked.values["load_kN"] == pytest.approx(plain.load_n / 1000.0, rel=1e-12)
    assert asked.values["param.method"] == "fdr"


def test_a_day_lasts_from_midnight_to_midnight(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        for hour in (0, 6, 12, 18, 23):
            made = datetime.fromisoformat(f"2026-05-01T{hour:02d}:00").astimezone()
            session.add(
                FileRow(
                    source="report",
                    path=f"{hour}",
                    content_hash="",
                    size_bytes=1,
                    media_type="",
                    created_at=made,
                )
            )

    def count(text: str) -> int:
        return len(ask(catalogue, f"report where created {text}").rows)

    assert count("= 2026-05-01") == count("<= 2026-05-01") == count(">= 2026-05-01") == 5
    assert count("between 2026-04-01 and 2026-05-01") == 5
    assert count("> 2026-05-01") == count("< 2026-05-01") == count("!= 2026-05-01") == 0
    assert count("> 2026-05-01T12:00") == 2
    assert count("in 2026-05") == count("= 2026-05") == count("in 2026") == count("<= 2026-05") == 5
    assert count("in (2026-04, 2026-06)") == count("> 2026") == count("< 2026-05") == 0
    assert count("not in 2026-04") == count("between 2026-04 and 2026-05") == count("> 2025-12") == 5
    assert count(">= 2026-05-01T12:00") == 3


def test_what_was_recorded_at_no_known_time_shows_none(catalogue: Catalogue) -> None:
    about = {"source": "report", "content_hash": "", "size_bytes": 1, "media_type": "", "created_at": NOW}
    with catalogue.writing() as session:
        session.add_all(FileRow(path=at.isoformat(), recorded_at=at, **about) for at in (UNTIMED, NOW))
    shown = {one.file.path: one.file.recorded_at for one in ask(catalogue, "report").rows}
    assert shown == {UNTIMED.isoformat(): None, NOW.isoformat(): NOW}


@pytest.mark.parametrize("text", ["strain where load_kN > 1000", "calibration = 1", ""])
def test_pages_make_up_the_whole_and_nothing_comes_twice(
    catalogue: Catalogue, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    many_files.fill(catalogue, 640)
    whole = [one.file.id for one in ask(catalogue, text, limit=1000).rows]
    for few in (query_files.FEW, -1):
        monkeypatch.setattr(query_files, "FEW", few)
        pages, after = [], None
        while True:
            page = ask(catalogue, text, limit=37, after=after)
            pages.append([one.file.id for one in page.rows])
            if page.next is None:
                break
            after = page.next
        assert [key for page_ids in pages for key in page_ids] == whole
        assert all(len(page_ids) == 37 for page_ids in pages[:-1])


def test_the_documented_queries_look_at_no_whole_table(catalogue: Catalogue) -> None:
    many_files.fill(catalogue, 20_000)
    done: list[tuple[str, Any]] = []
    event.listen(catalogue.engine, "before_cursor_execute", lambda *call: done.append((call[2], call[3])))
    for text in many_files.DOCUMENTED:
        done.clear()
        with catalogue.reading() as session:
            find_page(session, parse(text), KNOWN)
            asked = [(sql, values) for sql, values in done if sql.lstrip().startswith(("SELECT", "WITH"))]
            assert len(asked) >= 2
            for sql, values in asked:
                assert whole_tables(session, catalogue.dialect, sql, values) == set(), f"{text}: {sql}"


def whole_tables(session: Any, dialect: str, sql: str, values: Any) -> set[str]:
    """Return the large tables that a database would read from end to end."""
    connection = session.connection()
    if dialect == "sqlite":
        plan = [row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {sql}", values)]
        return {m[1] for step in plan if (m := re.match(r"SCAN (\w+)\b(?! USING)", step))} & LARGE
    # In this transaction PostgreSQL keeps to indexes where there are any.
    plan = [row[0] for row in connection.exec_driver_sql(f"EXPLAIN {sql}", values)]
    return {m[1] for step in plan if (m := re.search(r"Seq Scan on (\w+)", step))} & LARGE


MISTAKEN = [
    ("strian", "no kind 'strian'; did you mean 'strain'; there are .*at character 1 "),
    ("strain where lod_kN > 3", "nothing is called 'lod_kN'; did you mean 'load_n'.*at character 14 "),
    ("maximum_pricipal_strain > 3", "did you mean 'maximum_principal_strain'"),
    ("param.guage_length_mm = 30", "did you mean 'param.gauge_length_mm'"),
    ("chanel.temp_c > 3", "'chanel.' has no meaning; there are statistic., channel., param."),
    ("median > 3", "'median' may mean median_sigma_mm, median_von_mises_strain; write which"),
    ("load_kN > heavy", "'load_kN' is a number, and 'heavy' is none, at character 11 "),
    ("load_kN ~ 3", "'load_kN' has no text"),
    ("created > 3", "'created' is a time like 2026-05-01"),
    ("calibration > 1", "compared with =, != or in"),
    ("calibration = new", "asked for by its number"),
    ("param.method in (fdr, 3)", "values of different sorts"),
    ("load > 50", "'load' needs a unit.*or load_N or load_kN or load_MN, at character 1 "),
    ("load > 50 lb", "'lb' is no unit that is known; there are mm, .*at character 8 "),
    ("load > 50 mm", "'load' is in N, kN, MN, and '50 mm' is another quantity, at character 8 "),
    ("load > 50 kn", "'kn' is no unit"),
    ("valid_fraction < 50 N", "'valid_fraction' has no unit that is known, and '50 N'"),
    ("view = 5 mm", "'view' has no unit that is known"),
    ("load in (1 N, 2 kN)", "the values of 'load' have several units"),
    ("lod > 50 kN", "nothing is called 'lod'; did you mean 'load_n'"),
    ("valid_fractoin > 0", "did you mean 'valid_fraction'( or '[a-z_.]+'){,2}; docs/query.md has"),
    ("qqq > 0", "nothing is called 'qqq'; docs/query.md has the names, and 'sms data show FILE' those"),
    ("param.qqq > 0", "'param.qqq'.*; there are param.gauge_length_mm, param.method, at"),
]
"""What cannot be asked, and words of the answer."""


def test_what_cannot_be_asked_is_pointed_at(catalogue: Catalogue) -> None:
    many_files.fill(catalogue, 64)
    said = {text: refusal(catalogue, text) for text, _ in MISTAKEN}
    assert {text: said[text] for text, words in MISTAKEN if not re.search(words, said[text])} == {}


def refusal(catalogue: Catalogue, text: str) -> str:
    """Return why a question is refused; nothing where it is answered."""
    try:
        ask(catalogue, text)
    except InvalidInput as error:
        return str(error)
    return ""


def test_calibrations_are_a_column(catalogue: Catalogue) -> None:
    many_files.fill(catalogue, 64)
    with catalogue.writing() as session:
        session.add(
            FileRow(
                id=9,
                source="calibration",
                path="9",
                content_hash="",
                size_bytes=1,
                media_type="",
                created_at=NOW,
            )
        )
        session.flush()
        session.add(CalibrationRow(id=12, rig_id=1, file_id=9, valid_from=NOW, origin="", sensors={}))
        session.flush()
        session.add(CalibrationUseRow(calibration_id=12, file_id=10_001))
    found = ask(catalogue, "file between 10000 and 10002", columns=["file", "calibration"]).rows
    assert [one.values["calibration"] for one in found] == ["1", "1, 12", None]


def test_what_does_not_exist_is_said(catalogue: Catalogue) -> None:
    many_files.fill(catalogue, 64)
    with pytest.raises(NotFound, match="no campaign 'wing'; the latest are c00000"):
        ask(catalogue, "campaign = wing")
    with pytest.raises(NotFound, match="no calibration 7"):
        ask(catalogue, "calibration = 7")


def test_options_and_query_have_both_to_be_met(catalogue: Catalogue) -> None:
    many_files.fill(catalogue, 640)
    asked = restricted(
        parse("load_kN > 0 or load_kN <= 0"), kind="strain", campaign="c00000", state="S01", view="C1P2"
    )
    with catalogue.reading() as session:
        (found,) = find_page(session, asked, KNOWN).rows
    assert found.file.subject == "c00000/S01/C1P2"
    assert list(found.values) == ["load_kN"]
    with pytest.raises(InvalidInput, match="the query asks for strain, but `kind` is correlate"):
        restricted(parse("strain"), kind="correlate", campaign=None, state=None, view=None)
    with catalogue.reading() as session, pytest.raises(InvalidInput, match=r"no kind 'strian'.*'strain'"):
        find_page(session, restricted(parse(""), kind="strian", campaign=None, state=None, view=None), KNOWN)


def test_queries_are_kept_under_a_name(catalogue: Catalogue) -> None:
    many_files.fill(catalogue, 64)
    text = "strain where load_kN > 1400"
    with catalogue.writing() as session:
        saved.save(session, "heavy", text, NOW, KNOWN)
        refused: list[tuple[str, str, type[SmsError]]] = [
            ("heavy", "strain", Conflict),
            ("a b", "strain", InvalidInput),
            ("unknown", "strain where lod_kN > 3", InvalidInput),
        ]
        for name, other, error in refused:
            with pytest.raises(error):
                saved.save(session, name, other, NOW, KNOWN)
    with catalogue.writing() as session:
        assert [q.text for q in saved.saved(session)] == [text]
        saved.save(session, "heavy", "strain", NOW, KNOWN, replace=True)
        assert saved.text_of(session, "heavy") == "strain"
        saved.remove(session, "heavy")
        with pytest.raises(NotFound, match="no saved query 'heavy'; none is saved yet"):
            saved.remove(session, "heavy")


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    app(["data", *arguments], standalone_mode=False)
    return capsys.readouterr().out


def test_every_format_tells_the_same(home: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        key = session.scalars(select(FileRow.id).where(FileRow.source == "calibration")).one()
        session.add(StatisticRow(file_id=key, name="length_rms_mm", value=0.25))
    at = ("--home", str(home))
    text = "calibration where length_rms_um > 100"
    (listed,) = json.loads(run(capsys, "find", text, "--json", *at))
    assert listed["values"] == {"length_rms_um": 250.0}
    page = json.loads(run(capsys, "find", text, "--format", "json", *at))
    assert page == {"schema": 1, "files": [listed], "next": None}
    lines = run(capsys, "find", text, "--format", "lines", *at).splitlines()
    assert [json.loads(line) for line in lines] == [listed, {"schema": 1, "next": None}]
    run(capsys, "query", "save", "rough", text, *at)
    (row,) = csv.DictReader(io.StringIO(run(capsys, "query", "run", "rough", "--format", "csv", *at)))
    assert (row["path"], row["length_rms_um"]) == (listed["path"], "250.0")
    columns = ("--columns", "file,length_rms_mm,rig,load_n,calibration")
    header, told = run(capsys, "find", "calibration", "--format", "csv", *columns, *at).splitlines()
    assert header == "file,length_rms_mm,rig,load_n,calibration"
    assert re.fullmatch(rf"{key},0.25,[\w-]+,,", told)
    for refused in (
        ("find", text, "--format", "parquet"),
        ("find", text, "--json", "--format", "csv"),
        ("find", text, "--out", str(tmp_path / "a.txt")),
        ("find", text, "--format", "csv", "--out", str(tmp_path / "a.parquet")),
        ("find", "--columns", "file,,kind"),
        ("find", "--columns", "file,nothing"),
        ("find", "strain where"),
    ):
        with pytest.raises(InvalidInput):
            run(capsys, *refused, *at)
    for refused, said in (
        (("find", "--columns", "file,nothing"), "in `columns`, nothing is called 'nothing'; "),
        (("find", "--columns", "file,load"), "in `columns`, 'load' needs a unit: write load_N or load_kN or"),
        (
            ("states", "--columns", "lode_n"),
            "in `columns`, nothing is called 'lode_n'; did you mean 'load_n'",
        ),
        (("states", "--columns", "sensor.x"), "in `columns`, 'sensor.' has no meaning; there are statistic."),
    ):
        with pytest.raises(InvalidInput) as told_why:
            run(capsys, *refused, *at)
        assert str(told_why.value).startswith(said)
        assert "of the query" not in str(told_why.value)


def test_parquet_keeps_types(tmp_path: Path) -> None:
    rows = [(1, "a", 0.5, NOW, None, True), (2, None, None, None, None, False)]
    columns = ("file", "kind", "load_kN", "created", "empty", "reused")
    path = tmp_path / "found.parquet"
    assert write_parquet(path, columns, rows) == 2
    table = parquet.read_table(path)
    assert [str(kind) for kind in table.schema.types] == [
        "int64",
        "string",
        "double",
        "timestamp[us, tz=UTC]",
        "double",
        "bool",
    ]
    assert [tuple(row.values()) for row in table.to_pylist()] == rows
    # What is of several types in one column, as a parameter may be, is told in words.
    assert write_parquet(path, ["param.method"], [("fdr",), (3,), (NOW,), (None,)]) == 4
    assert parquet.read_table(path).column(0).to_pylist() == ["fdr", "3", NOW.isoformat(), None]
    assert write_parquet(path, ["file"], []) == 0
    assert parquet.read_table(path).num_rows == 0


def test_what_is_found_goes_into_a_parquet_file(
    home: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    make_home(home, {})
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        key = session.scalars(select(FileRow.id).where(FileRow.source == "calibration")).one()
        session.add(StatisticRow(file_id=key, name="length_rms_mm", value=0.25))
    at = ("--home", str(home))
    asked = ("find", "calibration where length_rms_um > 100")
    (listed,) = json.loads(run(capsys, *asked, "--json", *at))
    path = tmp_path / "found.parquet"
    run(capsys, *asked, "--out", str(path), *at)
    (row,) = parquet.read_table(path).to_pylist()
    assert row["length_rms_um"] == 250.0
    assert row["created"] == datetime.fromisoformat(listed["created_at"])
    assert {name: row[name] for name in ("path", "size_bytes", "content_hash")} == {
        name: listed[name] for name in ("path", "size_bytes", "content_hash")
    }
    with pytest.raises(Conflict, match="set `force`"):
        run(capsys, *asked, "--format", "parquet", "--out", str(path), *at)


def test_without_the_package_it_is_said_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # as if it were not installed
    path = tmp_path / "found.parquet"
    with pytest.raises(SmsError, match=r"pip install 'sms-jobs\[parquet\]'.*`format` csv"):
        write_parquet(path, ["file"], [(1,)])
    assert not path.exists()
