"""`data states`: the same answers from both databases as of looking at everything, by pages."""

from __future__ import annotations

import csv
import json
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from pyarrow import parquet
from sqlalchemy import select
from support import catalogues
from support.command import answer, inside
from support.homes import make_home
from support.jobs import NOW

from sms_jobs import bootstrap
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bench.large import many_files
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.queries.fields import Vocabulary
from sms_jobs.catalogue.queries.files import restricted
from sms_jobs.catalogue.queries.language import parse
from sms_jobs.catalogue.queries.states import find_page
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow, ReadingRow, StatisticRow
from sms_jobs.catalogue.tables.states import ChannelRow, LoadStateRow
from sms_jobs.cli.found_states import _shown
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.shown.portion import Portion
from sms_jobs.records.shown.states import FoundState, StatePage, table_of

KNOWN = Vocabulary(lambda: (frozenset({*many_files.KINDS, "merge"}), many_files.PARAMETERS))
NAN = float("nan")


def ask(catalogue: Catalogue, text: str, **more: Any) -> StatePage:
    with catalogue.reading() as session:
        return find_page(session, parse(text), KNOWN, DATASET_MEDIA_TYPE, Portion(**more))


def names(page: StatePage) -> list[str]:
    return [f"{one.values['campaign']}/{one.values['state']}" for one in page.rows]


@dataclass
class Plain:
    """A state with all that is known of it in one place, for a reference that does without SQL."""

    name: str
    load_n: float
    temp_c: float
    time: datetime
    told: dict[tuple[str, str], dict[str, float]] = field(default_factory=dict)
    """By kind and view, what the newest result tells."""

    def views(self) -> set[str]:
        return {view for _, view in self.told}

    def tells(self, kind: str, name: str) -> Callable[[str], float]:
        return lambda view: self.told.get((kind, view), {}).get(name, NAN)

    def any_view(self, meets: Callable[[str], bool]) -> bool:
        return any(map(meets, self.views()))


def everything(catalogue: Catalogue) -> list[Plain]:
    """Return every state, the newest campaign first."""
    with catalogue.reading() as session:
        told: dict[int, dict[str, float]] = defaultdict(dict)
        for key, name, value in session.execute(
            select(StatisticRow.file_id, StatisticRow.name, StatisticRow.value)
        ):
            told[key][name] = value
        read: dict[int, dict[str, float]] = defaultdict(dict)
        for key, name, value in session.execute(
            select(ReadingRow.file_id, ReadingRow.name, ReadingRow.value)
        ):
            read[key][name] = value
        recordings: dict[int, dict[str, MeasurementRow]] = defaultdict(dict)
        for one in session.scalars(select(MeasurementRow).order_by(MeasurementRow.file_id)):
            recordings[one.state_id][one.view] = one
        results: dict[int, dict[tuple[str, str], int]] = defaultdict(dict)
        for file in session.scalars(select(FileRow).order_by(FileRow.id)):
            if file.state_id is not None and file.media_type == DATASET_MEDIA_TYPE:
                results[file.state_id][file.source, file.view or ""] = file.id
        temperatures = dict(session.execute(select(ChannelRow.state_id, ChannelRow.value)).all())
        rows = session.execute(
            select(LoadStateRow, CampaignRow.name)
            .join(CampaignRow, CampaignRow.id == LoadStateRow.campaign_id)
            .order_by(CampaignRow.id.desc(), LoadStateRow.position)
        )
        return [
            Plain(
                f"{campaign}/{state.label}",
                mean([read[m.file_id].get("load_n") for m in recordings[state.id].values()], state.load_n),
                mean(
                    [read[m.file_id].get("temp_c") for m in recordings[state.id].values()],
                    temperatures.get(state.id),
                ),
                max((m.recorded_at for m in recordings[state.id].values()), default=state.time) or NOW,
                {place: told[key] for place, key in results[state.id].items()},
            )
            for state, campaign in rows
        ]


def mean(values: list[float | None], otherwise: float | None) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else NAN if otherwise is None else otherwise


def changed(catalogue: Catalogue) -> None:
    """Compute some results again, record a view again, merge a state, and lay a document beside a result."""
    with catalogue.writing() as session:
        places = {
            (s.campaign_id, s.position): s.id
            for s in session.scalars(select(LoadStateRow).where(LoadStateRow.position < 4))
        }

        def new(key: int, source: str, state: int, view: str | None, media: str = DATASET_MEDIA_TYPE) -> None:
            session.add(
                FileRow(
                    id=key,
                    source=source,
                    path=f"new/{key}",
                    content_hash="",
                    size_bytes=1,
                    media_type=media,
                    created_at=NOW,
                    recorded_at=NOW,
                    campaign_id=1,
                    state_id=places[1, state],
                    view=view,
                )
            )
            session.flush()

        new(900_001, "strain", 1, "C1P1")
        session.add(StatisticRow(file_id=900_001, name="valid_fraction", value=-1.0))
        # Computed once more, and now with nothing to tell of it.
        new(900_002, "strain", 2, "C1P1")
        new(900_003, "strain", 3, "C1P1", "text/html")
        new(900_004, "merge", 1, None)
        session.add(StatisticRow(file_id=900_004, name="faces", value=12.0))
        new(900_005, "measurement", 1, "C1P2")
        session.add(
            MeasurementRow(file_id=900_005, state_id=places[1, 1], view="C1P2", recorded_at=NOW),
        )
        session.add(ReadingRow(file_id=900_005, name="load_n", value=3e6))
        session.add(LoadStateRow(campaign_id=2, label="later", position=100, load_n=60e3, time=NOW))


@pytest.fixture(scope="module", params=["embedded", "grown"])
def filled(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, migrated_sqlite: Path
) -> Iterator[Catalogue]:
    """A full catalogue of either deployment, which all tests ask and none changes."""
    with ExitStack() as stack:
        if request.param == "embedded":
            file = shutil.copy(migrated_sqlite, tmp_path_factory.mktemp("filled"))
            url = f"sqlite:///{file}"
        else:
            server, template = map(request.getfixturevalue, ("postgresql", "_migrated_database"))
            url = stack.enter_context(catalogues.database(server, template))
        catalogue = stack.enter_context(closing(Catalogue(url)))
        many_files.fill(catalogue, 2000)  # the second campaign has states without files
        changed(catalogue)
        yield catalogue


def strain(state: Plain) -> Callable[[str], float]:
    return state.tells("strain", "valid_fraction")


QUESTIONS: list[tuple[str, Callable[[Plain], bool]]] = [
    ("", lambda s: True),
    ("load > 1400 kN", lambda s: s.load_n > 1.4e6),
    (
        "load_n between 1 and 2 MN and not state in (S01, S02)",
        lambda s: 1e6 <= s.load_n <= 2e6 and s.name[7:] not in ("S01", "S02"),
    ),
    ("time in 2020-01", lambda s: s.time.astimezone().strftime("%Y-%m") == "2020-01"),
    ("temp_c > 30 and campaign = c00000", lambda s: s.temp_c > 30.0 and s.name[:6] == "c00000"),
    ("strain.valid_fraction < 0.1", lambda s: s.any_view(lambda v: strain(s)(v) < 0.1)),
    ("strain where valid_fraction < 0.1", lambda s: s.any_view(lambda v: strain(s)(v) < 0.1)),
    ("not strain.valid_fraction < 0.9", lambda s: s.any_view(lambda v: strain(s)(v) >= 0.9)),
    # One view has to meet both.
    (
        "strain.valid_fraction < 0.3 and correlate.median_sigma > 40 um",
        lambda s: s.any_view(
            lambda v: strain(s)(v) < 0.3 and s.tells("correlate", "median_sigma_mm")(v) > 0.04
        ),
    ),
    (
        "strain.valid_fraction < 0.01 or load > 1.9 MN",
        lambda s: s.load_n > 1.9e6 or s.any_view(lambda v: strain(s)(v) < 0.01),
    ),
    (
        "view = C1P2 and max_principal > 1990 microstrain",
        lambda s: s.tells("strain", "maximum_principal_strain")("C1P2") > 1990e-6,
    ),
    (
        "camera = C2 and (max_principal > 1.99e-3 or load < 50 kN)",
        lambda s: s.any_view(
            lambda v: (
                v[:2] == "C2"
                and (s.tells("strain", "maximum_principal_strain")(v) > 1.99e-3 or s.load_n < 50e3)
            )
        ),
    ),
    ("merge.faces = 12", lambda s: s.told.get(("merge", ""), {}).get("faces") == 12.0),
    ("merge", lambda s: ("merge", "") in s.told),
    (
        "strain where load > 1.9 MN",
        lambda s: s.load_n > 1.9e6 and s.any_view(lambda v: ("strain", v) in s.told),
    ),
    ("campaign ~ 01 and specimen = specimen and rig ~ RI", lambda s: "01" in s.name[:6]),
    ("campaign != c00000 and state ~ later", lambda s: s.name == "c00001/later"),
]


def test_the_answers_are_those_of_looking_at_everything(filled: Catalogue) -> None:
    states = everything(filled)
    assert len(states) == 201
    found = 0
    for text, meets in QUESTIONS:
        page = ask(filled, text, limit=1000)
        expected = [one.name for one in states if meets(one)]
        assert names(page) == expected, text
        assert page.next is None
        found += 0 < len(expected) < len(states)
    assert found == len(QUESTIONS) - 1  # all but the first tell states apart


def test_what_is_told_is_what_the_newest_results_tell(filled: Catalogue) -> None:
    by_name = {one.name: one for one in everything(filled)}
    page = ask(filled, "load > 0 kN and strain.valid_fraction < 0.2 and time in 2020", limit=1000)
    assert page.columns == ("campaign", "state", "load_kN", "time", "strain.valid_fraction")
    assert page.by_view == ("strain.valid_fraction",)
    assert len(page.rows) > 20
    for one, name in zip(page.rows, names(page), strict=True):
        plain = by_name[name]
        # The mean over views and the change of unit: a few roundings.
        assert one.values["load_kN"] == pytest.approx(plain.load_n / 1e3, rel=1e-12)
        assert one.values["time"] == plain.time
        known = {v: strain(plain)(v) for v in plain.views() if strain(plain)(v) == strain(plain)(v)}
        assert {v: told["strain.valid_fraction"] for v, told in one.views.items()} == known
        assert one.met_by == tuple(sorted(v for v, value in known.items() if value < 0.2))
    first = one_of(ask(filled, "campaign = c00000 and state = S01 and strain.valid_fraction < 1"))
    assert first.views["C1P1"] == {"strain.valid_fraction": -1.0}
    assert first.values["load_n"] > 7e5  # a quarter of the 3 MN of the view that was recorded again


def one_of(page: StatePage) -> FoundState:
    (found,) = page.rows
    return found


def test_columns_are_those_that_are_asked_for(filled: Catalogue) -> None:
    columns = ("state", "merge.faces", "correlate.median_sigma_um", "planned_load_MN", "channel.temp_c")
    found = ask(filled, "campaign = c00000 and state in (S01, S02)", columns=columns)
    assert found.columns == columns
    assert found.by_view == ("correlate.median_sigma_um",)
    assert [one.values["merge.faces"] for one in found.rows] == [12.0, None]
    assert all(len(one.views) == 4 and one.met_by is None for one in found.rows)


@pytest.mark.parametrize("text", ["", "strain.valid_fraction < 0.5 or load > 1 MN"])
def test_pages_make_up_the_whole(filled: Catalogue, text: str) -> None:
    whole = names(ask(filled, text, limit=1000))
    pages: list[list[str]] = []
    after = None
    while not pages or after is not None:
        page = ask(filled, text, limit=17, after=after)
        pages.append(names(page))
        after = page.next
    assert [name for some in pages for name in some] == whole
    assert all(len(some) == 17 for some in pages[:-1])


MISTAKEN = [
    ("lod > 5 kN", "nothing is called 'lod'; did you mean 'load_n'.*at character 1 "),
    ("load > 50", "'load' needs a unit.*at character 1 "),
    ("load > 50 mm", "'load' is in N, kN, MN.*at character 8 "),
    ("strian where load > 5 N", "no kind 'strian'; did you mean 'strain'"),
    (
        "load > 5 N and valid_fraction < 0.8",
        r"may mean correlate\.valid_fraction, .*strain\.valid_fraction; write which, at character 16 ",
    ),
    ("strain.valid_fracton < 1", "did you mean 'strain.valid_fraction'"),
    ("calibration = 1", "'calibration' is of files: ask 'sms data find'"),
    ("param.method = fdr", "'param.method' is of files"),
    ("foo.bar > 1", "'foo.' has no meaning; there are statistic., channel., .*strain., at character 1 "),
    ("time > heavy", "'time' is a time like"),
]
"""What cannot be asked, and words of the answer."""


def test_views_are_in_the_order_of_their_cameras(filled: Catalogue) -> None:
    wanted = ("C1", "C1P1", "C2P1", "C10P1")
    with filled.reading() as session:
        state = session.scalars(select(LoadStateRow).where(LoadStateRow.label == "later")).one()
        files = [
            FileRow(
                id=910_000 + place,
                source="strain",
                path=f"many/{view}",
                content_hash="",
                size_bytes=1,
                media_type=DATASET_MEDIA_TYPE,
                created_at=NOW,
                campaign_id=2,
                state_id=state.id,
                view=view,
            )
            for place, view in enumerate(reversed(wanted))
        ]
        session.add_all(files)
        session.flush()
        session.add_all(StatisticRow(file_id=one.id, name="valid_fraction", value=0.5) for one in files)
        session.flush()
        # Nothing is kept: other tests ask the same catalogue.
        asked = parse("state = later and strain.valid_fraction < 1")
        found = one_of(find_page(session, asked, KNOWN, DATASET_MEDIA_TYPE))
        session.rollback()
    assert (tuple(found.views), found.met_by) == (wanted, wanted)
    titles, _ = table_of(["strain.valid_fraction"], ["strain.valid_fraction"], [found])
    assert titles == [*(f"strain.valid_fraction {view}" for view in wanted), "met_by"]
    _, (row,) = _shown(["strain.valid_fraction"], ["strain.valid_fraction"], [found])
    assert tuple(row[0].split("\n")) == wanted


def test_what_cannot_be_asked_is_pointed_at(filled: Catalogue) -> None:
    said = {text: refusal(filled, text) for text, _ in MISTAKEN}
    assert {text: said[text] for text, words in MISTAKEN if not re.search(words, said[text])} == {}


def refusal(catalogue: Catalogue, text: str) -> str:
    """Return why a question is refused; nothing where it is answered."""
    try:
        ask(catalogue, text)
    except InvalidInput as error:
        return str(error)
    return ""


def test_what_does_not_exist_is_said(filled: Catalogue) -> None:
    with pytest.raises(NotFound, match="no campaign 'wing'"):
        ask(filled, "campaign = wing")
    with pytest.raises(NotFound, match="no state with number 999"):
        ask(filled, "", after=999)
    with pytest.raises(InvalidInput, match="leave 'view' out"):
        ask(filled, "", columns=["state", "view"])


def test_options_and_query_have_both_to_be_met(filled: Catalogue) -> None:
    asked = restricted(parse("load > 0 N"), kind="strain", campaign="c00000", state="S07", view="C1P2")
    with filled.reading() as session:
        found = one_of(find_page(session, asked, KNOWN, DATASET_MEDIA_TYPE))
    assert (found.values["state"], found.met_by) == ("S07", ("C1P2",))


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home where two views have told of one state, and one of another."""
    home = tmp_path_factory.mktemp("states") / "home"
    make_home(home, {})
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        states = session.scalars(select(LoadStateRow).order_by(LoadStateRow.position)).all()
        for key, (state, view, value) in enumerate(
            [(states[0], "C1P1", 0.95), (states[1], "C1P1", 0.75), (states[1], "C2P2", 0.9)], start=1000
        ):
            session.add(
                FileRow(
                    id=key,
                    source="strain",
                    path=str(key),
                    content_hash="",
                    size_bytes=1,
                    media_type=DATASET_MEDIA_TYPE,
                    created_at=NOW,
                    campaign_id=state.campaign_id,
                    state_id=state.id,
                    view=view,
                )
            )
            session.flush()
            session.add(StatisticRow(file_id=key, name="valid_fraction", value=value))
    return home


QUESTION = "valid_fraction < 0.8"


def test_a_state_is_a_row_and_its_views_stand_below_each_other(told: Path) -> None:
    done = inside("data", "states", QUESTION, "--home", str(told), environment={"COLUMNS": "80"})
    assert done.returncode == 0
    title, first, second = done.stdout.splitlines()
    assert title.split() == ["campaign", "state", "load_n", "time", "view", "valid_fraction"]
    assert first.split()[-3:] == ["C1P1", "*", "0.75"]
    assert second.split() == ["C2P2", "0.9"]
    assert "*" in done.stderr


def test_every_format_tells_the_same(told: Path, tmp_path: Path) -> None:
    at = ("--home", str(told))
    (listed,) = answer("data", "states", QUESTION, *at)
    assert listed["views"] == {"C1P1": {"valid_fraction": 0.75}, "C2P2": {"valid_fraction": 0.9}}
    assert listed["met_by"] == ["C1P1"]
    page = json.loads(inside("data", "states", QUESTION, "--format", "json", *at).stdout)
    assert page == {"schema": 1, "states": [listed], "next": None}
    lines = inside("data", "states", QUESTION, "--format", "lines", *at).stdout.splitlines()
    assert [json.loads(line) for line in lines] == [listed, {"schema": 1, "next": None}]
    table, typed = tmp_path / "found.csv", tmp_path / "found.parquet"
    for path in (table, typed):
        assert inside("data", "states", QUESTION, "-o", str(path), *at).returncode == 0
    (row,) = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    (same,) = parquet.read_table(typed).to_pylist()
    assert list(row) == list(same)
    assert (row["valid_fraction C1P1"], row["valid_fraction C2P2"]) == ("0.75", "0.9")
    assert (same["valid_fraction C1P1"], same["met_by"]) == (0.75, "C1P1")
    assert row["state"] == same["state"] == listed["state"]


def test_wrong_requests_are_refused(told: Path, tmp_path: Path) -> None:
    for given, code, words in (
        (("load > 50",), 2, "needs a unit"),
        ((QUESTION, "-o", str(tmp_path / "x.html")), 2, "must end in .csv or .parquet"),
        ((QUESTION, "--format", "csv", "-o", str(tmp_path / "x.parquet")), 2, "must end in .csv"),
        ((QUESTION, "--json", "--format", "csv"), 2, "exclude each other"),
        (("campaign = none",), 3, "no campaign 'none'"),
        (("--columns", "state,,load_n"), 2, "empty name"),
    ):
        done = inside("data", "states", *given, "--home", str(told))
        assert (done.returncode, done.stdout) == (code, ""), given
        assert words in done.stderr
    assert list(tmp_path.iterdir()) == []
