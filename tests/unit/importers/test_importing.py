"""Imports end in catalogue and archive once, as a whole, and are found again from the archive alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text
from support.homes import initialised
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.app.specimens.campaigns import create
from sms_jobs.catalogue import campaigns, schema
from sms_jobs.catalogue.tables.every import METADATA
from sms_jobs.cli.importing.group import app
from sms_jobs.errors import Conflict, InvalidInput, SmsError
from sms_jobs.jobs.archiving.importing import amend_campaign, with_states
from sms_jobs.jobs.rebuilding.reindexing import reindex, unknown_files
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import Measurement
from tests.support.foreign_frames import ROWS, fringes, gray_frames, save

AT = datetime(2026, 5, 4, 10, 0, tzinfo=UTC)
Import = Callable[..., Any]


@pytest.fixture
def run(tmp_path: Path) -> Import:
    """Run an import in a home of its own, and return the JSON that it prints."""
    home = tmp_path / "home"
    initialised(home)

    def call(*arguments: str, code: int = 0) -> Any:
        done = CliRunner().invoke(app, [*arguments, "-c", "plate", "--home", str(home), "--json"])
        if isinstance(done.exception, SmsError):
            raise done.exception
        assert done.exit_code == code, (done.exception, done.stderr)
        return json.loads(done.stdout)

    return call


def frames(folder: Path, *options: str) -> tuple[str, ...]:
    given = ("--densities", "16 1", "--steps", "3", "--rig", "desk", "--yes")
    return ("frames", str(folder), *given, "--recorded-at", AT.isoformat(), *options)


def campaign_of(home: Path) -> Campaign:
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        return campaigns.definition(campaigns.campaign_row(session, "plate"))


def outcomes(told: Any) -> list[tuple[str, str]]:
    return [(t["state"], t["outcome"]) for t in told["tuples"]]


def test_frames_arrive_as_they_are_and_once(run: Import, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    levels = [np.rint(fringes(seed=i, noise=1.0)).astype(np.uint8) for i in range(2)]
    for label, shown in zip(("S00", "S01"), levels, strict=True):
        save(folder / label, shown)
    dry = run(*frames(folder, "--dry-run"))
    assert outcomes(dry) == [("S00", "would be imported"), ("S01", "would be imported")]
    with bootstrap.services(tmp_path / "home") as services:
        assert not list(services.archive.files())
    first = run(*frames(folder))
    assert outcomes(first) == [("S00", "imported"), ("S01", "imported")]
    with bootstrap.services(tmp_path / "home") as services:
        for one, shown in zip(first["tuples"], levels, strict=True):
            with services.archive.open_unrecorded(one["detail"]) as dataset:
                measurement = dataset.read("measurement", Measurement)
                np.testing.assert_array_equal(measurement.frames.rows(0, ROWS), shown)
                assert measurement.recorded_at == AT
                sources = dataset.provenance.parameters["files"]
                assert [s["name"] for s in sources] == [f"{one['state']}/frame_{i:02d}.png" for i in range(6)]
        before = sorted(services.archive.files())
    assert outcomes(run(*frames(folder))) == [("S00", "already there"), ("S01", "already there")]
    with bootstrap.services(tmp_path / "home") as services:
        assert sorted(services.archive.files()) == before
    # A copy elsewhere under other names is the same content.
    for path in sorted((folder / "S00").iterdir()):
        path.rename(path.with_name(path.name.replace("frame", "picture")))
    folder.rename(tmp_path / "copy")
    again = run(*frames(tmp_path / "copy", "--pattern", "{state}/*_{number}.png"))
    assert outcomes(again) == [("S00", "already there"), ("S01", "already there")]


def test_frames_of_another_state_are_remarked_on(run: Import, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    for label in ("S00", "S01"):
        save(folder / label, fringes(seed=int(label[1:]), noise=1.0))
    assert not [said for said in run(*frames(folder))["remarks"] if "same" in said]
    # A frame of a state that is there already, and one of the same folder.
    save(folder / "S02", fringes(seed=2, noise=1.0))
    save(folder / "S03", fringes(seed=3, noise=1.0))
    (folder / "S02" / "frame_03.png").write_bytes((folder / "S00" / "frame_03.png").read_bytes())
    (folder / "S03" / "frame_01.png").write_bytes((folder / "S02" / "frame_01.png").read_bytes())
    given = ("--add-states", "--only", "S0[23]/*")
    (said,) = (one for one in run(*frames(folder, *given))["remarks"] if "same" in one)
    assert "S02/frame_01.png and S03/frame_01.png have the same content" in said
    assert "of 1 other group" in said
    with pytest.raises(InvalidInput, match="is measured by rig desk, which stays"):
        run(*frames(folder, "--rig", "bench"))


@pytest.mark.parametrize(
    ("level", "told"),
    [
        (None, []),
        (0.0, ["images is blank: every pixel of S00/frame_06.png is 0"]),
        (255.0, ["is blank: every pixel", "saturate: 100% of S00/frame_06.png is at grey level 255"]),
    ],
)
def test_a_white_frame_without_texture_is_remarked_on(
    level: float | None, told: list[str], run: Import, tmp_path: Path
) -> None:
    shown = fringes(noise=1.0)
    white = 1.5 * shown.mean(axis=0) if level is None else np.full_like(shown[0], level)
    save(tmp_path / "scans" / "S00", np.concatenate([shown, white[None]]))
    remarks = run(*frames(tmp_path / "scans", "--frames", "fringes white"))["remarks"]
    found = [said for said in remarks if "matched" in said or "to match" in said]
    assert len(found) == len(told)
    assert all(words in said for words, said in zip(told, found, strict=True))


def test_a_bad_tuple_is_left_out_as_a_whole_and_the_others_come_in(run: Import, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    for label in ("S00", "S01", "S02"):
        save(folder / label, fringes(seed=int(label[1:]), noise=1.0))
    whole = (folder / "S01" / "frame_04.png").read_bytes()
    (folder / "S01" / "frame_04.png").write_bytes(whole[:-40])
    (folder / "notes.txt").write_text("who knows")
    told = run(*frames(folder), code=6)
    assert outcomes(told) == [("S00", "imported"), ("S01", "refused"), ("S02", "imported")]
    assert told["left_out"] == [{"file": "notes.txt", "why": "is no image"}]
    assert [s.label for s in campaign_of(tmp_path / "home").states] == ["S00", "S01", "S02"]
    (folder / "S01" / "frame_04.png").write_bytes(whole)
    mended = run(*frames(folder))
    assert outcomes(mended) == [("S00", "already there"), ("S01", "imported"), ("S02", "already there")]


def test_what_contradicts_the_campaign_is_refused(run: Import, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    save(folder / "S00", fringes())
    run(*frames(folder))
    save(folder / "S01", fringes(seed=1, noise=1.0))
    with pytest.raises(InvalidInput, match="no state S01: set `add_states`"):
        run(*frames(folder))
    with pytest.raises(InvalidInput, match="no view C2P1"):
        run(*frames(folder, "--view", "C2P1"))
    with pytest.raises(InvalidInput, match="import into another campaign"):
        run(*frames(folder, "--densities", "9 1"))
    assert outcomes(run(*frames(folder, "--add-states"))) == [("S00", "already there"), ("S01", "imported")]
    save(folder / "S00", fringes(seed=5, noise=1.0))
    told = run(*frames(folder), code=6)
    assert outcomes(told) == [("S00", "refused"), ("S01", "already there")]
    assert "set `newer`" in told["tuples"][0]["detail"]
    assert outcomes(run(*frames(folder, "--newer")))[0] == ("S00", "imported")


PLAN = """
name = "plate"
rig = "desk"
views = ["C1C2P1"]
[specimen]
name = "plate"
[[states]]
label = "S00"
[sequence]
densities = [16, 1]
steps = 3
"""


def test_frames_of_two_cameras_come_into_a_view_that_has_both(run: Import, tmp_path: Path) -> None:
    (tmp_path / "plan.toml").write_text(PLAN, encoding="utf-8")
    with bootstrap.services(tmp_path / "home") as services:
        create(services, tmp_path / "plan.toml")
    both = ("--orientations", "0 90")
    for number, camera in enumerate(("C1", "C2")):
        shown = fringes(orientations_deg=(0.0, 90.0), seed=number, noise=1.0)
        save(tmp_path / "scans" / "S00" / f"{camera}P1", shown)
    # Frames of one camera are of that camera: those of both cannot be told apart.
    named = ("--view", "C1C2P1", "--state", "S00", "--pattern", "frame_{number}.png", *both)
    alone = tmp_path / "scans" / "S00" / "C1P1"
    with pytest.raises(InvalidInput, match="no view C1C2P1 of which frames are recorded; it has C1P1, C2P1"):
        run(*frames(alone, *named))
    told = run(*frames(tmp_path / "scans", *both))
    assert [(t["view"], t["outcome"]) for t in told["tuples"]] == [("C1P1", "imported"), ("C2P1", "imported")]
    assert campaign_of(tmp_path / "home").views == ("C1C2P1",)


def test_a_new_campaign_has_no_frames_of_several_cameras_in_one(run: Import, tmp_path: Path) -> None:
    save(tmp_path / "scans", fringes())
    named = ("--view", "C1C2P1", "--state", "S00", "--pattern", "frame_{number}.png")
    refused = run(*frames(tmp_path / "scans", *named), code=6)
    assert "the view C1C2P1 is recorded as C1P1 and C2P1" in refused["tuples"][0]["detail"]


def test_a_guess_that_nobody_confirms_changes_nothing(run: Import, tmp_path: Path) -> None:
    save(tmp_path / "scans" / "S00", fringes())
    with pytest.raises(InvalidInput, match="say --yes"):
        run("frames", str(tmp_path / "scans"), "--densities", "16 1", "--rig", "desk")
    with bootstrap.services(tmp_path / "home") as services:
        assert not list(services.archive.files())


def test_readings_become_load_and_channels(run: Import, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    for i in range(3):
        save(folder / f"S0{i}", fringes(seed=i, noise=1.0))
    run(*frames(folder))
    table = tmp_path / "log.csv"
    table.write_bytes(
        "# a comment\nState;Kraft [kN];T (°C);SG 1\nS00;0;20,5;0\nS01;12,5;;571,4\nS09;1;1;1\n".encode(
            "cp1252"
        )
    )
    maps = ("--map", "Kraft [kN]=load[kN]", "--map", "T (°C)=temperature[°C]", "--map", "SG 1=gauge_1[um/m]")
    told = run("channels", str(table), *maps)
    assert len(told["left_out"]) == 2  # a state that is unknown, a temperature that is not there
    first, second, third = campaign_of(tmp_path / "home").states
    assert (first.measured_load_n, first.channels) == (0.0, {"temperature_C": 20.5, "gauge_1": 0.0})
    assert (second.measured_load_n, second.channels) == (12_500.0, {"gauge_1": 571.4e-6})
    assert (third.measured_load_n, third.channels) == (None, {})
    assert run("channels", str(table), *maps)["changes"] == []
    table.write_text("State;SG 1\nS01;600\n")
    with pytest.raises(Conflict, match=r"gauge_1 = 0\.0005714 already"):
        run("gauges", str(table), "--map", "SG 1=gauge_1")
    run("gauges", str(table), "--map", "SG 1=gauge_1", "--replace")
    assert campaign_of(tmp_path / "home").states[1].channels == {"gauge_1": 600e-6}


def test_readings_find_their_state_by_time(run: Import, tmp_path: Path) -> None:
    for i in range(2):
        save(tmp_path / "scans" / f"S0{i}", fringes(seed=i, noise=1.0))
    run(*frames(tmp_path / "scans", "--state", "S00"))
    table = tmp_path / "log.csv"
    table.write_text(
        "time,force [N]\n2026-05-04T11:59:58,1\n2026-05-04T12:00:00.400,2\n2026-05-04T12:00:03,3\n"
    )
    with pytest.raises(InvalidInput, match="has no zone"):
        run("channels", str(table), "--map", "force [N]=load[N]")
    # Two states were held at one time: the row is that of the first.
    told = run("channels", str(table), "--map", "force [N]=load[N]", "--time-zone", "Europe/Berlin")
    assert told["states"] == ["S00"]
    assert campaign_of(tmp_path / "home").states[0].measured_load_n == 2.0


def test_imports_are_told_again_by_the_archive(run: Import, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    save(folder / "S00", np.concatenate([fringes((32,), 12), gray_frames(6)]), "{}.png")
    options = ("--rig", "desk", "--densities", "32", "--steps", "12", "--gray-bits", "6", "--yes")
    told = run("frames", str(folder), *options, "--frames", "fringes gray")
    table = tmp_path / "log.csv"
    table.write_text("state,a\nS00,1\n")
    run("channels", str(table), "--map", "a=a_mm")
    known = campaign_of(tmp_path / "home")
    with bootstrap.services(tmp_path / "home") as services:
        METADATA.drop_all(services.catalogue.engine)
        with services.catalogue.writing() as session:
            session.execute(text("DROP TABLE IF EXISTS alembic_version"))
        schema.upgrade(services.catalogue)
        done = list(
            reindex(services.catalogue, services.archive, unknown_files(services.catalogue, services.archive))
        )
        # The measurement, and the definitions from before the channel and with it.
        assert [one.outcome for one in done] == ["indexed"] * 3
    assert campaign_of(tmp_path / "home") == known
    again = run("frames", str(folder), *options, "--frames", "fringes gray")
    assert again["tuples"][0]["outcome"] == "already there"
    assert again["tuples"][0]["detail"] == told["tuples"][0]["detail"]


def test_a_campaign_changes_by_states_and_readings_alone(run: Import, tmp_path: Path) -> None:
    save(tmp_path / "scans" / "S00", fringes())
    run(*frames(tmp_path / "scans"))
    before = campaign_of(tmp_path / "home")
    with bootstrap.services(tmp_path / "home") as services:
        files = sorted(services.archive.files())
        with pytest.raises(InvalidInput, match="nothing else"):
            amend_campaign(services.catalogue, services.archive, before, replace(before, rig="other"), AT)
        after = with_states(before, ["S01", "S02", "S00"])
        assert [s.label for s in after.states] == ["S00", "S01", "S02"]
        with pytest.raises(Conflict, match="by someone else"):
            amend_campaign(services.catalogue, services.archive, after, after, AT)
        assert sorted(services.archive.files()) == files
        amend_campaign(services.catalogue, services.archive, before, after, AT)
    assert campaign_of(tmp_path / "home") == after
