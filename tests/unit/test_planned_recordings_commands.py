"""What people type to plan the recordings of a test, and what they are told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select
from support.command import answer, inside
from support.homes import initialised
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.campaign import CampaignDefinition, LoadState
from sms_jobs.virtual_rig.campaigns import small_plate

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [
    { name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 },
    { name = "P2", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 },
]
file_channels = [
    { name = "load_n", path = "load.csv", column = "load", unit = "kN" },
    { name = "cycles", path = "load.csv", column = "cycles", unit = "1" },
    { name = "crack", path = "load.csv", column = "crack", unit = "mm" },
]
"""
PLAN = "the file of a test plan"


@pytest.fixture
def services(home: Path, tmp_path: Path) -> Iterator[Services]:
    """A home with a test of four states at 0, 10, 20 and 30 kN, and its rig."""
    initialised(home)
    (tmp_path / "rig.toml").write_text(RIG)
    calibration, campaign = small_plate("wing")
    states = tuple(LoadState(f"S{n:02d}", 10_000.0 * n) for n in range(4))
    rig = replace(calibration.rig, name="bench")
    with bootstrap.services(home) as found:
        found.stations.add(tmp_path / "rig.toml", replace=False)
        record, calibration = replace(campaign, rig="bench", states=states), replace(calibration, rig=rig)
        register_campaign(found.catalogue, found.archive, record, calibration, datetime.now(UTC), PLAN)
        yield found


def plan(services: Services, *words: str) -> Any:
    return answer("acquire", "plan", *words, "--home", str(services.settings.home))


def triggers(services: Services, *words: str) -> dict[str, str]:
    return {one["state"]: one["trigger"] for one in plan(services, *words)}


def refused(services: Services, *words: str) -> tuple[int, str]:
    done = inside(*words, "--home", str(services.settings.home))
    return done.returncode, done.stderr


def test_loads_are_in_the_unit_of_the_channel(services: Services) -> None:
    found = triggers(services, "wing", "--on", "load_n", "--tolerance", "500N", "--hold", "1min")
    assert found["S02"] == "load_n = 20 +- 0.5 kN for 1 min"
    assert list(found) == ["S00", "S01", "S02", "S03"]


def test_each_number_of_cycles_is_for_a_state(services: Services) -> None:
    found = triggers(services, "wing", "--at-cycles", "1000,2000", "--hold", "0s")
    assert found == {"S00": "cycles >= 1000", "S01": "cycles >= 2000"}
    # What is left follows, and one that is planned waits for something else from now on.
    assert triggers(services, "wing", "--next")["S03"] == "in its turn"
    found = triggers(services, "add", "wing", "--state", "S01", "--every", "90min")
    assert list(found.values()) == ["cycles >= 1000", "every 90 min", "in its turn", "in its turn"]


def test_what_comes_next_is_told_with_what_it_waits_for(services: Services) -> None:
    plan(services, "wing", "--on", "load_n", "--tolerance", "500N")
    inside("acquire", "plan", "skip", "wing", "--home", str(services.settings.home))
    home = str(services.settings.home)
    told = inside("acquire", "plan", "show", "--home", home).stdout
    assert "wing/S01 is next: waits for load_n = 10 +- 0.5 kN for 5 s" in told
    assert "no worker serves rig-bench" in told
    assert "next of wing  S01, waits for load_n" in inside("status", "--home", home).stdout
    assert "held back: S01, S02, S03" in inside("acquire", "plan", "hold", "wing", "--home", home).stderr
    assert [one["status"] for one in answer("status", "--home", home)["planned"]] == ["held"]


def test_a_rig_that_lacks_a_sensor_is_refused_before_anything_is_submitted(
    services: Services, tmp_path: Path
) -> None:
    one_projector = "\n".join(line for line in RIG.splitlines() if "P2" not in line)
    (tmp_path / "lacking.toml").write_text(one_projector.replace("columns = 128", "columns = 64"))
    services.stations.add(tmp_path / "lacking.toml", replace=True)
    said = (
        "error: the file of rig bench has no P2; it has C1, P1; C1 has 64 x 128 px in the file of rig bench, "
        "and 128 x 128 px in the plan: correct one of them\n"
    )
    recording, levels = ("acquire", "run", "wing", "--no-wait"), ("acquire", "plan", *LEVELS)
    for words in (recording, (*recording, "--key"), ("acquire", "plan", "wing", "--next"), levels):
        assert refused(services, *words) == (2, said)
    home = str(services.settings.home)
    assert answer("job", "list", "--home", home) == []
    # Of a rig that is connected to another host nothing is known.
    (services.settings.rig_folder / "bench.toml").unlink()
    assert len(answer(*recording, "--home", home)["jobs"]) == 4


LEVELS = ("wing", "--on", "load_n", "--each", "10kN", "--tolerance", "200N")


def test_levels_are_planned_shown_held_and_dropped(services: Services) -> None:
    home = str(services.settings.home)
    told = inside("acquire", "plan", *LEVELS, "--hold", "10s", "--process", "--home", home)
    said = "wing: a new state at each multiple of 10 kN at which load_n stays for 10 s; the next is S04\n"
    assert said in told.stdout
    assert "wing/S04 is next: waits for load_n = any multiple of 10 +- 0.2 kN for 10 s" in told.stdout
    assert "no worker serves rig-bench" in told.stdout
    (one,) = plan(services, "show")
    assert (one["state"], one["is_added"], one["status"]) == ("S04", True, "planned")
    assert answer("campaign", "show", "wing", "--home", home)["campaign"]["states"][-1]["label"] == "S03"
    assert "next of wing  S04, waits for load_n" in inside("status", "--home", home).stdout
    assert "held back: S04" in inside("acquire", "plan", "hold", "wing", "--home", home).stderr
    assert "it is held back" in plan(services, "show", "wing")[0]["waits_for"]
    assert "goes on: S04" in inside("acquire", "plan", "go", "wing", "--home", home).stderr
    # States that are there come first, and are planned as ever; other levels take the place of these.
    assert triggers(services, "wing", "--next")["S04"].startswith("load_n = any multiple of 10")
    assert [one["is_next"] for one in plan(services, "show")] == [True, False, False, False, False]
    assert triggers(services, *LEVELS, "--hold", "0s")["S04"].endswith("+- 0.2 kN for 0 s")
    assert refused(services, "acquire", "plan", "drop", "wing")[0] == 0
    assert plan(services, "show") == []


def test_levels_of_a_counter_have_no_unit(services: Services) -> None:
    told = inside(
        *("acquire", "plan", "wing", "--on", "cycles", "--each", "1000", "--tolerance", "5"),
        *("--home", str(services.settings.home)),
    )
    assert "a new state at each multiple of 1000 at which cycles stays for 5 s" in told.stdout


def test_a_session_is_given_no_poses(services: Services) -> None:
    session = small_session("poses")
    register_campaign(services.catalogue, services.archive, session, None, datetime.now(UTC))
    found = refused(services, "acquire", "plan", "poses", *LEVELS[1:])
    assert (found[0], "poses is a calibration session" in found[1]) == (2, True)


UNCLEAR = [
    ("wing", 2, "say what to wait for"),
    ("wing --each 10kN", 2, "say what to wait for"),
    ("wing --each 10kN --next", 2, "--each goes with --on CHANNEL"),
    ("wing --each 10kN --every 5s", 2, "--each goes with --on CHANNEL"),
    ("wing --each 10kN --at-cycles 5", 2, "--each goes with --on CHANNEL"),
    ("wing --each 10kN --at-cycles 5 --on load_n", 2, "--each goes with --on CHANNEL"),
    ("wing --on load_n --each 10kN", 2, "--tolerance how near load_n must be"),
    ("wing --on load_n --each 10 --tolerance 1N", 2, "each is '10', which has no unit: write it in N"),
    ("wing --on load_n --each 10mm --tolerance 1N", 2, "'mm' is no unit of it"),
    ("wing --on load_n --each 10kN --tolerance 1", 2, "'1', which has no unit"),
    ("wing --on load_n --each 10kN --tolerance 0N", 2, "give one above 0"),
    ("wing --on load_n --each 0kN --tolerance 1N", 2, "loads are apart by more than 0"),
    ("wing --on load_n --each -5kN --tolerance 1N", 2, "--each is '-5kN', and loads are apart"),
    ("wing --on load_n --each 10kN --tolerance 5kN", 2, "give a tolerance below 5 kN, or a greater"),
    ("wing --on load_n --each 10kN --tolerance 1N -s S00", 2, "and S00 is no new one: leave out --state"),
    ("wing --on strain --each 10kN --tolerance 1N", 3, "rig bench has no channel 'strain'"),
    ("tail --on load_n --each 10kN --tolerance 1N", 3, "no campaign 'tail'"),
    ("wing --next --every 5s", 2, "say what to wait for"),
    ("wing --on load_n --at-cycles 5 --next", 2, "say what to wait for"),
    ("wing --every 15", 2, "'15', which has no unit: write it in s, ms, min, h"),
    ("wing --every 15m", 2, "'m' is no unit of it"),
    ("wing --every 0s", 2, "between 1 and"),
    ("wing --on load_n", 2, "--tolerance how near load_n must be"),
    ("wing --on load_n --tolerance 500", 2, "'500', which has no unit: write it in N, kN, MN"),
    ("wing --on load_n --tolerance 5mm", 2, "'mm' is no unit of it"),
    ("wing --on load_n --tolerance 0N", 2, "give one above 0"),
    ("wing --on load_n --tolerance 5N --hold 10", 2, "'10', which has no unit"),
    ("wing --on crack --tolerance 1mm", 2, "does not say what crack is at state S00"),
    ("wing --on strain --tolerance 1mm", 3, "rig bench has no channel 'strain'; it has load_n"),
    ("wing --at-cycles 1,1", 2, "should exceed the one before"),
    ("wing --at-cycles 1k", 2, "should be whole numbers"),
    ("wing --at-cycles 1,2,3,4,5", 2, "5 numbers of cycles are given for 4 states"),
    ("wing --at-cycles 1 -s S00 -s S01", 2, "1 numbers of cycles are given for 2 states"),
    ("wing --at-cycles 5 --tolerance 1N", 2, "--tolerance goes with --on"),
    ("wing --every 5s --hold 1s", 2, "--hold goes with"),
    ("tail --next", 3, "no campaign 'tail'"),
    ("wing --next --stop-if g1.z_mm>5", 2, "'5', which has no unit: write it in mm"),
    ("wing --next --stop-if g1.z>5mm", 2, "is no limit of a gauge: write GAUGE.extension_mm > 0.5mm"),
    ("wing --next --stop-if g1.z_mm>5mm", 3, "wing has no gauge 'g1' in mm; it has none"),
    ("looks tail", 3, "no campaign 'tail'"),
    ("watch tail", 3, "no campaign 'tail'"),
    ("wing --next -s S09", 2, "no state S09"),
    ("show tail", 3, "no campaign 'tail'"),
    ("skip wing", 3, "nothing is left to record"),
    ("hold wing", 3, "nothing is planned of wing"),
    ("move wing S01", 2, "say where it is to come"),
    ("move wing S01 --last", 3, "nothing is planned of wing/S01"),
]
"""Commands that are refused, with which exit code, and words of what is said."""


def test_what_is_not_clear_is_refused(services: Services) -> None:
    answers = {words: refused(services, "acquire", "plan", *words.split()) for words, _, _ in UNCLEAR}
    wrong = [
        words for words, code, said in UNCLEAR if answers[words][0] != code or said not in answers[words][1]
    ]
    assert {words: answers[words] for words in wrong} == {}
    assert plan(services, "show") == []


def test_what_is_looked_at_and_where_that_stops_the_plan_is_told(home: Path) -> None:
    initialised(home)
    calibration, campaign = small_plate("wing")
    gauges: Any = {"gauges": {"gauge": "g1 x=0 y=0 length=60; c1 x=9px y=9px length=9px"}}
    with bootstrap.services(home) as found:
        record = replace(campaign, processing=gauges)
        register_campaign(found.catalogue, found.archive, record, calibration, datetime.now(UTC), PLAN)
        planned = plan(found, "wing", "--next", "--stop-if", "g1.z_mm > 2mm", "--stop-if", "g1.x_mm<-1mm")
        assert [one["stop_if"] for one in planned] == [["g1.z_mm > 2 mm", "g1.x_mm < -1 mm"]] * 2
        assert {one["stopped_by"] for one in planned} == {""}
        assert (plan(found, "looks", "wing"), plan(found, "show", "wing")) == ([], planned)
        # A gauge of a camera alone has no place on a surface.
        said = refused(found, "acquire", "plan", "wing", "-s", "S01", "--next", "--stop-if", "c1.z_mm>2mm")[1]
        assert "wing has no gauge 'c1' in mm; it has g1" in said
        # Where nothing is left that could come, watching has an end.
        assert refused(found, "acquire", "plan", "drop", "wing")[0] == 0
        assert refused(found, "acquire", "plan", "watch", "wing") == (0, "")


def test_a_state_is_added_while_the_test_goes_on(services: Services) -> None:
    home = str(services.settings.home)
    before = answer("campaign", "show", "wing", "--home", home)
    plan(services, "wing", "--next")
    assert answer("campaign", "add-state", "wing", "S04", "--load", "45kN", "--home", home)["states"] == 5
    after = answer("campaign", "show", "wing", "--home", home)
    assert after["campaign"]["states"][:4] == before["campaign"]["states"]
    assert (after["campaign"]["states"][4]["load_n"], after["plan"]) == (45_000.0, PLAN)
    assert triggers(services, "wing", "--every", "10s")["S04"] == "every 10 s"
    with services.catalogue.reading() as session:
        paths = session.scalars(select(FileRow.path).where(FileRow.source == "campaign")).all()
    with services.archive.open_unrecorded(max(paths)) as dataset:
        kept = dataset.read("campaign", CampaignDefinition)
    assert ([s.label for s in kept.campaign.states][-1], kept.plan) == ("S04", PLAN)


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("wing S03 --load 1N", 4, "has a state S03 already"),
        ("wing S04 --load 20", 2, "'20', which has no unit: write it in N, kN, MN, such as 20N"),
        ("wing S04 --load 20mm", 2, "'mm' is no unit of it"),
        ("wing S/4", 2, "cannot be the name of a state"),
        ("tail S04", 3, "no campaign 'tail'"),
    ],
)
def test_a_state_that_cannot_be_added_is_refused(
    services: Services, words: str, code: int, said: str
) -> None:
    found = refused(services, "campaign", "add-state", *words.split())
    assert (found[0], said in found[1]) == (code, True)
