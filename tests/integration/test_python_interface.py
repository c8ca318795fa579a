"""A home in Python, here and at a server: what docs/python.md shows runs, and says what the archive holds."""

from __future__ import annotations

import json
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from support.archives import Clock, registered, run_jobs, runner, work_again
from support.serving import serving

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.app.specimens import campaigns
from sms_jobs.app.work import jobs
from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import ConfigurationError, InvalidInput, JobFailed, NotFound, WaitTimedOut
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.lab import Lab
from sms_jobs.records.reasons import Reason
from sms_jobs.records.shown.planned_recordings import Dropped
from sms_jobs.virtual_rig.campaigns import small_plate

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "python.md").read_text("utf-8"), re.M | re.S)
CAMPAIGN = "top-hat-small"
"""The name of the demo's campaign, which is a smaller one here."""
ADDRESS = f"{CAMPAIGN}/S01/C1P1"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a home in it, whose jobs up to strain have been done."""
    folder = tmp_path_factory.mktemp("python")
    home = folder / "sms-demo"
    bootstrap.initialise(home)
    clock, archive = Clock(), Archive(FolderStore(home / "archive"))
    with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue:
        work_again(catalogue, clock)
        registered(catalogue, archive, clock, CAMPAIGN)
        kinds = ("simulate", "reconstruct", "correlate", "strain")
        run_jobs(catalogue, archive, clock, [Request(kind) for kind in kinds], CAMPAIGN)
    return folder


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    with serving(folder / "sms-demo") as url:
        yield url


@pytest.fixture(params=["home", "server"])
def lab(folder: Path, request: pytest.FixtureRequest) -> Iterator[Lab]:
    """The same home twice, in which the same has to be found."""
    if request.param == "home":
        opened = sms_jobs.open(folder / "sms-demo")
    else:
        opened = sms_jobs.connect(request.getfixturevalue("address"))
    with opened as lab:
        yield lab


@contextmanager
def served(home: Path) -> Iterator[None]:
    """Run what is queued meanwhile, as the service of a home does."""
    ending = threading.Event()

    def serve() -> None:
        with closing(Catalogue(f"sqlite:///{home / 'catalogue.sqlite'}")) as catalogue:
            here = runner(catalogue, Archive(FolderStore(home / "archive")), Clock())
            while not ending.wait(0.05):
                here.run_queued()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def test_the_page_runs(folder: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert len(BLOCKS) >= 8
    names: dict[str, object] = {}
    with served(folder / "sms-demo"):
        for block in BLOCKS:
            here = block.replace("http://127.0.0.1:8470", address)
            exec(compile(here, "docs/python.md", "exec"), names)


def test_a_server_gives_what_the_home_holds(folder: Path, address: str) -> None:
    with sms_jobs.open(folder / "sms-demo") as here, sms_jobs.connect(address) as there:
        for what in ("strain", "displacement", "surface", "phase", "measurement"):
            assert there.read(ADDRESS, what).identical(here.read(ADDRESS, what))
        columns = ["created", "size", "state", "load_N", "median_sigma_strain"]
        tables = [lab.find(columns=columns).table() for lab in (here, there)]
        assert len(tables[0]) > 3
        assert tables[0].equals(tables[1])
        assert list(here.find("strain")) == list(there.find("strain"))


def test_what_is_found_is_walked_through_and_tabled(lab: Lab) -> None:
    found = lab.find("kind = strain")
    assert {file.subject for file in found} == {ADDRESS}
    table = found.table()
    assert list(table.columns) == ["file", "kind", "subject", "created"]
    assert table.loc[0, "kind"] == "strain"
    assert len(lab.find("strain where load_N > 1e9")) == 0
    assert lab.find("strain where load_N > 1e9").table().empty
    assert len(lab.find(limit=3)) == 3
    with pytest.raises(InvalidInput, match="character"):
        lab.find("strain where")


def test_states_are_a_table_here_and_at_a_server(folder: Path, address: str) -> None:
    campaign, state, view = ADDRESS.split("/")
    with sms_jobs.open(folder / "sms-demo") as here, sms_jobs.connect(address) as there:
        for query in ("", "load < 1 N", "strain.valid_fraction > 0 and load < 100 kN", "load > 1e9 N"):
            assert here.states(query).equals(there.states(query)), query
        columns = ["state", "load_kN", "strain.valid_fraction"]
        table = there.states(f"campaign = {campaign} and strain.valid_fraction > 0", columns=columns)
        assert list(table.columns) == ["state", "load_kN", f"strain.valid_fraction {view}", "met_by"]
        found = here.find("strain", columns=["valid_fraction", "load_kN"]).table()
        # The newest result counts; files come the newest first.
        assert table[f"strain.valid_fraction {view}"].tolist() == found["valid_fraction"].tolist()[:1]
        assert table["load_kN"].tolist() == found["load_kN"].tolist()[:1]
        assert table["state"].tolist() == [state]
        assert table.attrs["next"] is None
        assert there.states(limit=1).attrs["next"] == here.states(limit=1).attrs["next"] is not None
        with pytest.raises(InvalidInput, match="needs a unit"):
            there.states("load > 50")


def test_a_field_is_what_was_archived_and_says_so(lab: Lab) -> None:
    strain = lab.read(ADDRESS, "strain")
    file = next(iter(lab.find("kind = strain")))
    assert strain.attrs["file"] == file.id
    assert strain.attrs["content_hash"] == file.content_hash
    assert strain.attrs["subject"] == ADDRESS
    assert strain.attrs["job"] == file.job_id
    assert strain.strain.dims == ("strain_component", "row", "column")
    assert list(strain.strain_component.values) == ["xx", "yy", "xy"]
    assert strain.sigma.dims == strain.strain.dims
    assert strain.strain.attrs["long_name"] == "strain"
    masks = strain.reason.attrs["flag_masks"]
    assert masks.dtype == strain.reason.dtype
    assert len(strain.reason.attrs["flag_meanings"].split()) == len(masks) == len(Reason)
    valid = (strain.reason == 0).values
    assert valid.any()
    assert np.isfinite(strain.strain.values[:, valid]).all()
    assert np.isnan(strain.strain.values[:, ~valid]).all()
    # What is no array stands in the attributes, by its name in the record.
    assert strain.attrs["measure"] == "green-lagrange"
    assert strain.attrs["gauge_length"] > 0.0


def test_records_are_read_by_kind_by_name_and_by_file(lab: Lab) -> None:
    shape = lab.read(ADDRESS, "reconstruct")
    assert shape.identical(lab.read(ADDRESS, "surface"))
    assert shape.identical(lab.read(shape.attrs["file"]))
    phase = lab.read(shape.attrs["file"], "phase")
    assert phase.attrs["record"] == "phase"
    assert json.loads(phase.attrs["orientations_rad"]) == [0.0, pytest.approx(np.pi / 2)]
    measurement = lab.read(ADDRESS, "measurement")
    assert "texture" in measurement
    assert "frames" not in measurement


@pytest.mark.parametrize(
    ("subject", "what"),
    [(ADDRESS, "merge"), (ADDRESS, "nonsense"), ("nobody/S01/C1P1", "strain"), (999, None)],
)
def test_what_is_not_there_is_said(lab: Lab, subject: str | int, what: str | None) -> None:
    with pytest.raises(NotFound, match=r"there is no"):
        lab.read(subject, what)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (lambda lab: lab.read(ADDRESS, "displacement", frame="World"), "'world' or 'specimen', not 'World'"),
        (lambda lab: lab.find("strain", limit=-1), "`limit` is 1 or more, not -1"),
        (lambda lab: lab.states(limit=0), "`limit` is 1 or more, not 0"),
        (lambda lab: lab.find("strain", columns="state"), r"give \['state'\], not 'state'"),
        (lambda lab: lab.find(5), "a query is a text .* not 5"),
        (lambda lab: lab.submit("strain", CAMPAIGN, states=[], dry_run=True), "`states` is empty"),
        (lambda lab: lab.submit("strain", CAMPAIGN, views=(), dry_run=True), "`views` is empty"),
        (lambda lab: lab.wait([]), r"a job is what `submit` has returned, .* not \[\]"),
        (lambda lab: lab.wait(None), "a job is what `submit` has returned, .* not None"),
        (lambda lab: lab.explain(5), "a job is the beginning of a job's id, not 5"),
    ],
)
def test_what_cannot_be_meant_is_refused(lab: Lab, asked: Callable[[Lab], object], said: str) -> None:
    with pytest.raises(InvalidInput, match=said):
        asked(lab)


def test_what_was_closed_answers_nothing(folder: Path) -> None:
    lab = sms_jobs.open(folder / "sms-demo")
    lab.close()
    with pytest.raises(InvalidInput, match=r"the home .*sms-demo was closed .* open it again"):
        lab.find("strain")


def test_a_job_that_does_not_succeed_is_an_error(lab: Lab, folder: Path) -> None:
    with pytest.raises(InvalidInput, match="gauge"):
        lab.submit("strain", CAMPAIGN, dry_run=True, gauge_length_mm=-1.0)
    for kind, several, told in (
        (["strain", "merge"], (), "the kind is one name, not .'strain', 'merge'."),
        ("strain", "S01", r"`states` are a list of names: give \['S01'\], not 'S01'"),
    ):
        with pytest.raises(InvalidInput, match=told):
            lab.submit(kind, CAMPAIGN, states=several, dry_run=True)  # type: ignore[arg-type]
    done = lab.submit("strain", CAMPAIGN, gauge_length_mm=25.0)
    with pytest.raises(WaitTimedOut, match="1 of 1 job has not ended"):
        lab.wait(done, timeout_s=0.0)
    with bootstrap.services(folder / "sms-demo") as services:
        assert jobs.cancel(services, done.job_ids, None) == 1
    with pytest.raises(JobFailed, match="the last was strain"):
        lab.wait(done)
    assert "cancelled" in lab.explain(done.job_ids[0])


def test_a_plan_of_recordings_is_made_changed_and_forgotten(lab: Lab, folder: Path) -> None:
    # The plan is gone at the end, as it was before.
    with bootstrap.services(folder / "sms-demo") as services:
        if "plate" not in campaigns.names(services):
            calibration, plate = small_plate("plate")
            register_campaign(services.catalogue, services.archive, plate, calibration, datetime.now(UTC))
    plans = lab.recordings
    made = plans.plan("plate", ["S00", "S01"], every_s=900.0, process=True)
    assert [(one.state, one.status, one.is_next) for one in made] == [
        ("S00", "planned", True),
        ("S01", "planned", False),
    ]
    assert "15 min" in made[0].trigger
    assert plans.hold("plate") == ["S00", "S01"]
    assert plans.go("plate", ["S01"]) == ["S01"]
    plans.move("plate", "S01", before="S00")
    assert [(one.state, one.status) for one in plans.show("plate")] == [("S01", "planned"), ("S00", "held")]
    assert [one.campaign for one in plans.show()] == ["plate", "plate"]
    assert plans.skip("plate") == ["S01"]
    assert plans.drop("plate", ["S01"]) == Dropped(("S01",))
    assert plans.drop("plate") == Dropped(("S00",))
    assert plans.show() == []
    with pytest.raises(NotFound, match="nothing is planned of plate"):
        plans.drop("plate")
    with pytest.raises(InvalidInput, match="give one thing to wait for"):
        plans.plan("plate", every_s=900.0, at_cycles=[1000, 2000])
    with pytest.raises(InvalidInput, match="every_s"):
        plans.plan("plate", every_s=0.1)
    with pytest.raises(NotFound, match="there is no campaign 'gone'"):
        plans.show("gone")


@pytest.mark.parametrize("package", ["pandas", "xarray"])
def test_a_missing_extra_is_named(lab: Lab, monkeypatch: pytest.MonkeyPatch, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigurationError, match=rf"{package} is not installed.*sms-jobs\[notebook\]"):
        lab.find().table() if package == "pandas" else lab.read(ADDRESS, "strain")


def test_a_folder_that_is_no_home_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="sms init"):
        sms_jobs.open(tmp_path / "nowhere")
