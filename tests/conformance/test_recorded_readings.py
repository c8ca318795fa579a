"""Time and load of a recording reach all that is computed from it, and come back from files alone."""

from __future__ import annotations

import json

import pytest
from sqlalchemy import select
from support.archives import Clock, everything, rebuilt, registered, run_jobs, work_again
from support.deployments import Deployment

from sms_jobs.app.holdings.finding import vocabulary
from sms_jobs.archive import Archive
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.queries.files import find_page
from sms_jobs.catalogue.queries.language import parse
from sms_jobs.catalogue.tables.files import FileRow, MeasurementRow
from sms_jobs.formats.importers.readings import Reading
from sms_jobs.jobs.archiving.importing import amend_campaign, with_readings
from sms_jobs.jobs.devices.stations import Stations
from sms_jobs.jobs.keeping import retention
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.records.shown.files import Page
from sms_jobs.records.shown.portion import Portion

RIG = """
name = "small-virtual-rig"
cameras = [{{ name = "C1", driver = "simulated", columns = 128, rows = 128 }}]
projectors = [{{ name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 }}]
file_channels = [
    {{ name = "load_n", path = "{readings}", column = "1", unit = "kN", stale_after_s = 0 }},
    {{ name = "temp_c", path = "{readings}", column = "2", unit = "C", stale_after_s = 0 }},
]
"""
READ = {"S00": (0.012, 20.25), "S01": (1.187, 21.5)}
"""Load in kN and temperature, which the plan says to be 0 and 1200 N, and does not say."""
OF_A_STATE = {"measurement", "reconstruct", "correlate", "strain", "merge", "export", "assess"}


@pytest.fixture
def recorded(deployment: Deployment, catalogue: Catalogue, archive: Archive, clock: Clock) -> Archive:
    """An archive with a campaign that was recorded with instruments, and all that follows from it.

    Over servers shapes alone, since the rest takes long and asks the same of the database.
    """
    home = deployment.home
    registered(catalogue, archive, clock)
    rig = home / "bench.toml"
    rig.write_text(RIG.format(readings=home / "readings.csv"))
    Stations(home / "rigs", home / "spool").add(rig, replace=False)
    for state, read in READ.items():
        record(catalogue, archive, clock, state, read)
    run_jobs(
        catalogue, archive, clock, [Request("pipeline" if deployment.name == "embedded" else "reconstruct")]
    )
    return archive


def record(
    catalogue: Catalogue, archive: Archive, clock: Clock, state: str, read: tuple[float, float]
) -> None:
    """Record a state while a load in kN and a temperature are read."""
    (archive.store.root.parent / "readings.csv").write_text("{},{}\n".format(*read))
    run_jobs(catalogue, archive, clock, [Request("acquire", states=(state,))])


def ask(catalogue: Catalogue, text: str, columns: list[str] | None = None) -> Page:
    with catalogue.reading() as session:
        return find_page(session, parse(text), vocabulary(), Portion(columns, limit=1000))


def found(catalogue: Catalogue, text: str) -> set[tuple[str, str]]:
    return {(one.file.source, one.file.subject.removeprefix("plate")) for one in ask(catalogue, text).rows}


def kinds(catalogue: Catalogue, text: str) -> set[str]:
    return {source for source, _ in found(catalogue, text)}


def check_questions(catalogue: Catalogue) -> None:
    """Ask for results by what was read while they were recorded, and by when that was."""
    heavy = found(catalogue, "load_n between 1186 and 1188")
    assert heavy == found(catalogue, "state = S01") == found(catalogue, "planned_load_n = 1200")
    assert found(catalogue, "load_kN < 0.013 and load_kN > 0.011") == found(catalogue, "state = S00")
    assert found(catalogue, "load_n = 1200") == found(catalogue, "load_n = 0") == set()
    for name in ("temp_c", "channel.temp_c"):
        assert found(catalogue, f"{name} > 21") == heavy
    with catalogue.reading() as session:
        moments = session.scalars(select(MeasurementRow.recorded_at).order_by(MeasurementRow.file_id)).all()
    since = f"time >= '{moments[1].isoformat()}'".replace("'", "").replace("+00:00", "Z")
    assert found(catalogue, f"{since} and load_n > 1000") == heavy
    # The report shows both states, so that it is as young as the younger; it has no load of its own.
    assert found(catalogue, since) == heavy | found(catalogue, "report")
    assert found(catalogue, "report where load_n > 0") == set()
    asked = ask(catalogue, "state = S01", ["load_kN", "planned_load_kN", "temp_c", "time"]).rows
    assert {tuple(one.values.values()) for one in asked} == {(1.187, 1.2, 21.5, moments[1])}


def test_results_are_found_by_time_and_load_of_their_recording(
    deployment: Deployment, catalogue: Catalogue, recorded: Archive, clock: Clock
) -> None:
    if deployment.name == "embedded":
        assert kinds(catalogue, "state = S01") == OF_A_STATE
        assert_charted(catalogue, recorded)
    check_questions(catalogue)
    before = everything(catalogue)
    assert all(before.values())
    rebuilt(catalogue, recorded)
    after = everything(catalogue)
    assert (after["readings"], after["files"]) == (before["readings"], before["files"])
    check_questions(catalogue)
    work_again(catalogue, clock)
    # Recorded again, old and new results are each of their own recording.
    record(catalogue, recorded, clock, "S01", (1.25, 22.0))
    run_jobs(catalogue, recorded, clock, [Request("reconstruct", states=("S01",))])
    newer, older = ask(catalogue, "reconstruct where load_n > 100").rows
    assert [one.values["load_n"] for one in (newer, older)] == pytest.approx([1250.0, 1187.0])
    with catalogue.writing() as session:
        retention.forget(session, [older.file.id])
    assert len(ask(catalogue, "reconstruct where load_n > 100").rows) == 1


def assert_charted(catalogue: Catalogue, archive: Archive) -> None:
    """See that the report is drawn over what was measured."""
    with catalogue.reading() as session:
        (path,) = session.scalars(select(FileRow.path).where(FileRow.source == "report"))
    page = archive.store.path(path).read_text()
    (block,) = [part.split("</script>")[0] for part in page.split('class="axes">')[1:]]
    axes = {axis["label"]: axis["places"] for axis in json.loads(block)}
    assert axes["load [N]"] == pytest.approx({"S00": 12.0, "S01": 1187.0})
    assert axes["temp_c"] == {"S00": 20.25, "S01": 21.5}


def test_readings_that_were_entered_leave_the_plan_as_it_is(
    catalogue: Catalogue, archive: Archive, clock: Clock
) -> None:
    registered(catalogue, archive, clock)
    run_jobs(catalogue, archive, clock, [Request("simulate"), Request("reconstruct")])
    assert found(catalogue, "reconstruct where load_n = 1200") == {("reconstruct", "/S01/C1P1")}
    with catalogue.reading() as session:
        before = campaigns.definition(campaigns.campaign_row(session, "plate"))
    after, changes = with_readings(before, [Reading("S01", {}, load_n=1190.0)])
    assert changes == ["S01: measured_load_n = 1190.0"]
    amend_campaign(catalogue, archive, before, after, clock())
    assert found(catalogue, "reconstruct where load_n = 1200") == set()
    for text in ("load_n = 1190", "planned_load_n = 1200"):
        assert found(catalogue, f"reconstruct where {text}") == {("reconstruct", "/S01/C1P1")}
