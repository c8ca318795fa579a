"""Images of several cameras: which name says the camera, which measure together, which states are whole."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.homes import initialised
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.valid_calibrations import ValidCalibrations
from sms_jobs.cli.importing.group import app
from sms_jobs.errors import InvalidInput, SmsError
from sms_jobs.formats.importers.image_names import guess_image_pattern
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from tests.support.foreign_frames import save

FINDINGS = 6
COLUMNS, ROWS = 24, 18
CAMERAS = "left=C1 right=C2"
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    initialised(tmp_path / "home")
    return tmp_path / "home"


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Three states of two cameras."""
    for name in ("left", "right"):
        save(tmp_path / "pair", rng.integers(0, 256, (3, ROWS, COLUMNS)), name + "_{}.png")
    return tmp_path / "pair"


def images(folder: Path, home: Path, *options: str, name: str = "panel", code: int = 0) -> Any:
    arguments = ["images", str(folder), "-c", name, "--home", str(home), "--json", "--yes", *options]
    done = CliRunner().invoke(app, arguments)
    if isinstance(done.exception, SmsError):
        raise done.exception
    assert done.exit_code == code, (done.exception, done.stderr)
    return json.loads(done.stdout)


def campaign_of(home: Path, name: str = "panel") -> Campaign:
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        return campaigns.definition(campaigns.campaign_row(session, name))


def outcomes(told: Any) -> list[tuple[str, str, str]]:
    return [(t["state"], t["view"], t["outcome"]) for t in told["tuples"]]


def camera(name: str, degrees: float, towards: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Sensor:
    """Return a camera 500 mm from the origin, so many degrees round it, which sees 30 x 22 mm there."""
    at = 500.0 * np.array([np.sin(np.radians(degrees)), 0.0, -np.cos(np.radians(degrees))])
    lens = Intrinsics(fx=400.0, fy=400.0, cx=COLUMNS / 2 - 0.5, cy=ROWS / 2 - 0.5)
    pose = Pose.looking_at(at, np.array(towards), np.array([0.0, -1.0, 0.0]))
    return Sensor(name, Role.CAMERA, COLUMNS, ROWS, lens, pose)


def calibrate(home: Path, *sensors: Sensor, since: datetime = datetime(2020, 1, 1, tzinfo=UTC)) -> None:
    box = Box((-40.0, -40.0, -20.0), (40.0, 40.0, 20.0))
    with bootstrap.services(home) as services:
        calibration = Calibration(Rig("rig", sensors), box, since, "made up")
        now = datetime.now(UTC)
        register_calibration(services.catalogue, services.archive, calibration, now, accepted=True)


@pytest.mark.parametrize(
    ("names", "cameras", "pattern"),
    [
        ("GT4-000{}_{}.tif", "01", "GT4-{state}_{camera}.tif"),
        ("step_{0}_{1}.png", "01", "step_{state}_{camera}.png"),
        ("{1}/load{0}.png", ("cam0", "cam1"), "{camera}/load{state}.png"),
        ("{1}{0}.jpg", ("left", "right"), "{camera}{state}.jpg"),
        ("leftover_{0}_{1}.png", ("left", "right"), "leftover_{state}_{camera}.png"),
    ],
)
def test_the_part_that_the_cameras_are_named_by_is_found(names: str, cameras: Any, pattern: str) -> None:
    assert guess_image_pattern([names.format(k, c) for k in range(3) for c in cameras], cameras) == pattern


def test_names_may_differ_in_words_and_times_too() -> None:
    both = ["L_0000_0.tif", "R_0000_1.tif", "L_0001_0.tif", "R_0001_1.tif"]
    assert guess_image_pattern(both, "01") == "*_{state}_{camera}.tif"
    assert guess_image_pattern(both, "LR") == "{camera}_{state}_*.tif"
    timed = [f"{c}_{k:02}_{1200 + 7 * k + n}.png" for k in range(3) for n, c in enumerate("LR")]
    # No two images have one time, so that it is no state.
    assert guess_image_pattern(timed, "LR") == "{camera}_{state}_*.png"


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (["left_0.png", "left_1.png"], "'right' for a camera, as left_0.png"),
        (["left_0.png", "right_0.png"], "left_0.png varies but the camera"),
        (["left_0.png", "0-right-0-0.png"], "differ in more than the camera"),
    ],
)
def test_names_that_tell_too_little_are_refused(names: list[str], complaint: str) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        guess_image_pattern(names, ("left", "right"))


@pytest.mark.skipif(not (DATA / "stereo").is_dir(), reason=f"published images are not in {DATA}")
@pytest.mark.parametrize(("path", "states"), [("stereo/gt4/images", 6), ("dic/stereo_sample3", 3)])
def test_published_stereo_images_need_no_pattern(home: Path, path: str, states: int) -> None:
    told = images(DATA / path, home, "--cameras", "0=C1 1=C2", "--dry-run")
    expected = [(f"{k:04}", c, "would be imported") for k in range(states) for c in ("C1", "C2")]
    assert outcomes(told) == expected


def test_two_cameras_measure_together_unless_it_is_said_otherwise(home: Path, folder: Path) -> None:
    told = images(folder, home, "--cameras", CAMERAS)
    assert outcomes(told) == [(str(k), c, "imported") for k in range(3) for c in ("C1", "C2")]
    assert any("rig camera has no calibration, without which C1C2" in r for r in told["remarks"])
    assert campaign_of(home).views == ("C1C2",)
    assert {o for *_, o in outcomes(images(folder, home, "--cameras", CAMERAS))} == {"already there"}
    images(folder, home, "--cameras", "right=C2 left=C1", name="turned")
    assert campaign_of(home, "turned").views == ("C2C1",)
    images(folder, home, "--cameras", CAMERAS, "--alone", name="alone")
    assert campaign_of(home, "alone").views == ("C1", "C2")
    # What is there stays what it is.
    for options in (("--alone",), ("--views", "C2C1")):
        with pytest.raises(InvalidInput, match="has the views C1C2, which stay"):
            images(folder, home, "--cameras", CAMERAS, *options)
    with pytest.raises(InvalidInput, match="takes no separate images of C3; its views are C1C2"):
        images(folder, home, "--camera", "C3", "--pattern", "left_{state}.png")


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--cameras", CAMERAS, "--views", "C1C3"), "view C1C3 needs C3, of which there is no image"),
        (("--cameras", CAMERAS, "--views", "C1P1"), "has a projector"),
        (("--cameras", CAMERAS, "--views", "C1C2 C1C2"), "each view once"),
        (("--cameras", CAMERAS, "--views", "both"), "'both' is not a view"),
        (("--cameras", CAMERAS, "--views", "C1", "--alone"), "some of them together: give one"),
        (("--cameras", "left=C1 left=C2"), "name left twice"),
        (("--cameras", "left=C1 right=C1"), "name C1 twice"),
        (("--cameras", CAMERAS, "--pattern", "left_{state}.png"), "write {camera} there"),
    ],
)
def test_what_cannot_be_changes_nothing(
    home: Path, folder: Path, options: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        images(folder, home, *options)
    with bootstrap.services(home) as services:
        assert not list(services.archive.files())


def test_a_camera_in_no_view_is_left_out(home: Path, folder: Path) -> None:
    told = images(folder, home, "--cameras", CAMERAS, "--views", "C2")
    assert outcomes(told) == [(str(k), "C2", "imported") for k in range(3)]
    assert {"file": "left_0.png", "why": "is of C1, which none of the views C2 has"} in told["left_out"]


def test_a_state_that_lacks_an_image_is_left_out_until_it_has_it(home: Path, folder: Path) -> None:
    kept = folder.parent / "kept.png"
    (folder / "right_1.png").rename(kept)
    told = images(folder, home, "--cameras", CAMERAS, code=FINDINGS)
    assert [one for one in outcomes(told) if one[2] == "refused"] == [("1", "C1", "refused")]
    assert "state 1 has no image of C2" in told["tuples"][2]["detail"]
    assert [s.label for s in campaign_of(home).states] == ["0", "2"]
    kept.rename(folder / "right_1.png")
    with pytest.raises(InvalidInput, match="no state 1: set `add_states`"):
        images(folder, home, "--cameras", CAMERAS)
    told = images(folder, home, "--cameras", CAMERAS, "--add-states")
    assert [one for one in outcomes(told) if one[2] == "imported"] == [
        ("1", "C1", "imported"),
        ("1", "C2", "imported"),
    ]
    # The archive has the other camera's image.
    for file in folder.glob("left_*"):
        file.unlink()
    told = images(folder, home, "--camera", "C2", "--pattern", "right_{state}.png")
    assert {o for *_, o in outcomes(told)} == {"already there"}


def test_no_other_state_becomes_the_reference_unasked(home: Path, folder: Path) -> None:
    (folder / "right_0.png").unlink()
    with pytest.raises(InvalidInput, match="state 0, which displacements start from, has no image of C2"):
        images(folder, home, "--cameras", CAMERAS)
    images(folder, home, "--cameras", CAMERAS, "--reference", "2", code=FINDINGS)
    assert [s.label for s in campaign_of(home).states] == ["2", "1"]


def test_a_reference_whose_name_no_state_can_have_is_not_left_out(home: Path, folder: Path) -> None:
    for name in ("left", "right"):
        (folder / f"{name}_0.png").rename(folder / f"{name}_-1.png")
    pattern = ("--cameras", CAMERAS, "--pattern", "{camera}_{state}.png")
    with pytest.raises(InvalidInput, match="state -1, which displacements start from, has no name"):
        images(folder, home, *pattern)
    images(folder, home, *pattern, "--reference", "1", code=FINDINGS)
    assert [s.label for s in campaign_of(home).states] == ["1", "2"]


def test_two_images_of_one_camera_and_state_are_refused(home: Path, folder: Path) -> None:
    (folder / "again").mkdir()
    (folder / "again" / "left_1.png").write_bytes((folder / "left_1.png").read_bytes())
    for file in (*folder.glob("left*"), *folder.glob("right*")):
        (folder / "first").mkdir(exist_ok=True)
        file.rename(folder / "first" / file.name)
    told = images(folder, home, "--cameras", CAMERAS, "--pattern", "*/{camera}_{state}.png", code=FINDINGS)
    refused = [t for t in told["tuples"] if t["outcome"] == "refused"]
    assert [(t["state"], t["view"]) for t in refused] == [("1", "C1"), ("1", "C2")]
    assert "are of one state and camera" in refused[0]["detail"]
    assert "nothing of state 1 is taken, for its image of C1 has a fault" in refused[1]["detail"]


def test_sizes_are_those_that_are_calibrated(home: Path, folder: Path, rng: np.random.Generator) -> None:
    calibrate(home, camera("C1", -10.0), camera("C2", 10.0), since=datetime(2021, 1, 1, tzinfo=UTC))
    told = images(folder, home, "--cameras", CAMERAS, "--rig", "rig")
    assert not any("calibration" in remark for remark in told["remarks"])
    save(folder, rng.integers(0, 256, (3, ROWS, COLUMNS + 2)), "right_{}.png")
    told = images(folder, home, "--cameras", CAMERAS, "--rig", "rig", name="wide", code=FINDINGS)
    refused = {view: [t["detail"] for t in told["tuples"] if t["view"] == view] for view in ("C1", "C2")}
    words = "it has 26 x 18 px, and calibration 1 of rig rig is of C2 with 24 x 18"
    assert [words in detail for detail in refused["C2"]] == [True] * 3
    assert ["its image of C2 has a fault" in detail for detail in refused["C1"]] == [True] * 3
    assert {outcome for *_, outcome in outcomes(told)} == {"refused"}
    # Alone they need no calibration; before it began there is none.
    images(folder, home, "--cameras", CAMERAS, "--rig", "rig", "--alone", "--dry-run", name="other")
    early = ("--recorded-at", "2020-06-01T00:00:00Z", "--dry-run")
    told = images(folder, home, "--cameras", CAMERAS, "--rig", "rig", *early, name="other")
    assert any("valid from 2021-01-01" in remark for remark in told["remarks"])


def test_times_of_files_that_choose_a_calibration_are_told(home: Path, folder: Path) -> None:
    for year in (2020, 2022):
        calibrate(home, camera("C1", -10.0), camera("C2", 10.0), since=datetime(year, 1, 1, tzinfo=UTC))
    for file in folder.iterdir():
        at = datetime(2021 if file.name.endswith("_0.png") else 2023, 6, 1, tzinfo=UTC).timestamp()
        os.utime(file, (at, at))
    arguments = ("--cameras", CAMERAS, "--rig", "rig", "--dry-run")
    (said,) = (one for one in images(folder, home, *arguments)["remarks"] if "times of the files" in one)
    assert "2021-06-01T00:00:00+00:00 to 2023-06-01T00:00:00+00:00, calibration 1 and 2 of rig rig" in said
    told = images(folder, home, *arguments, "--recorded-at", "2021-06-01T00:00:00Z")
    assert not [one for one in told["remarks"] if "calibration" in one]


def test_a_camera_that_is_not_calibrated_is_named(home: Path, folder: Path) -> None:
    calibrate(home, camera("C1", -10.0), camera("C3", 10.0))
    told = images(folder, home, "--cameras", CAMERAS, "--rig", "rig")
    words = "calibration 1 of rig rig has no camera C2, without which C1C2 of campaign panel measures nothing"
    assert [words in remark for remark in told["remarks"]].count(True) == 1
    assert {outcome for *_, outcome in outcomes(told)} == {"imported"}


def test_of_many_cameras_those_pairs_measure_that_see_a_thing_together(
    home: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    for number in range(1, 6):
        save(tmp_path / "ring" / f"C{number}", rng.integers(0, 256, (1, ROWS, COLUMNS)), "s{}.png")
    pattern = ("--pattern", "{camera}/s{state}.png", "--rig", "rig")
    told = images(tmp_path / "ring", home, *pattern, "--dry-run")
    assert any("all 10 pairs of 5 cameras are taken" in remark for remark in told["remarks"])
    calibrate(
        home,
        camera("C1", -30.0),
        camera("C2", 30.0),
        camera("C3", 110.0),
        # It looks away from what the others see.
        camera("C4", 0.0, towards=(500.0, 0.0, -500.0)),
    )
    told = images(tmp_path / "ring", home, *pattern)
    assert campaign_of(home).views == ("C1C2", "C3", "C4", "C5")
    remarks = " ".join(told["remarks"])
    assert "together: C1C2 (" in remarks
    assert "C2C3 is not taken by calibration 1 of rig rig: they see it from directions" in remarks
    assert "C1C4 is not taken by calibration 1 of rig rig: they see nothing" in remarks
    assert "C1C5 is not taken by calibration 1 of rig rig: not both are in it" in remarks
    assert "C3 and C4 and C5 each measure in the plane of their own image, without a partner" in remarks


def test_a_view_of_several_cameras_was_measured_when_its_images_were(
    home: Path, folder: Path, rng: np.random.Generator
) -> None:
    images(folder, home, "--cameras", CAMERAS, "--recorded-at", "2021-05-04T10:00:00Z")
    save(folder, rng.integers(0, 256, (3, ROWS, COLUMNS)), "left_{}.png")
    images(folder, home, "--cameras", CAMERAS, "--recorded-at", "2022-01-01T00:00:00Z", "--newer")
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        valid = ValidCalibrations(session, campaigns.campaign_id(session, "panel"), datetime.now(UTC))
        assert valid.time_of(Subject("panel", "1", "C1C2")) == datetime(2022, 1, 1, tzinfo=UTC)
