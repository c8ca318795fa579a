"""Images of calibration boards: a folder becomes a session, and the session calibrates its cameras."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.calibration_sessions import SessionInMemory
from support.homes import initialised
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.catalogue import campaigns
from sms_jobs.cli.importing.group import app
from sms_jobs.errors import InvalidInput, SmsError
from sms_jobs.formats.calibration_figures import draw_expected_sigma
from sms_jobs.formats.importers.boards import load_board, session_of_boards
from sms_jobs.jobs.archiving.calibrations import measuring_pairs
from sms_jobs.kinds.calibration import calibrate_boards, observe_board
from sms_jobs.kinds.calibration.sessions import OBSERVE_BOARD, board_states, every_view
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.metrology.geometry.camera import PER_SENSOR, Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import compose
from sms_jobs.records.artefacts import Chessboard, CircleBoard
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.observations import BoardObservation
from sms_jobs.records.sensors import Calibration, SensorFormat
from sms_jobs.records.subject import Subject

ROWS, COLUMNS, FINER = 240, 320, 4
AT = datetime(2026, 6, 1, 8, tzinfo=UTC)
# Six by five corners: no half turn brings the board to itself.
BOARD = Chessboard(6, 5, 10.0)
LENS = Intrinsics(420.0, 421.0, 161.0, 118.5)
BASE = Pose.from_arrays(cv2.Rodrigues(np.array([0.0, 0.25, 0.02]))[0], np.array([-60.0, 1.0, 6.0]))
POSES = [
    ((0.0, 0.0, 0.0), (-24.0, -18.0, 250.0)),
    ((0.5, 0.1, 0.0), (-30.0, -12.0, 255.0)),
    ((-0.5, 0.15, 0.1), (-20.0, -25.0, 265.0)),
    ((0.1, 0.5, 0.2), (-16.0, -16.0, 240.0)),
    ((0.1, -0.5, -0.1), (-34.0, -22.0, 245.0)),
    ((0.3, 0.3, 0.7), (-8.0, -32.0, 220.0)),
]


def picture(pose: Pose) -> NDArray[np.uint8]:
    """Return what the camera sees of the board, sampled 4 x 4 times a pixel."""
    corners = np.array([[x, y, 0.0] for x in (0.0, 50.0) for y in (0.0, 40.0)])
    seen = project(LENS, pose, corners)
    flat, _ = cv2.findHomography(seen, corners[:, :2])
    fine = (np.arange(FINER) + 0.5) / FINER - 0.5
    x = (np.arange(COLUMNS)[:, None] + fine).ravel()
    y = (np.arange(ROWS)[:, None] + fine).ravel()
    grid = np.stack([*np.meshgrid(x, y), np.ones((y.size, x.size))], axis=-1) @ flat.T
    place = grid[..., :2] / grid[..., 2:] / BOARD.pitch_mm
    column, row = np.floor(place[..., 0]), np.floor(place[..., 1])
    on = (column >= -1) & (column < BOARD.columns) & (row >= -1) & (row < BOARD.rows)
    light = np.where(on & ((column + row) % 2 == 0), 40.0, 200.0)
    return light.reshape(ROWS, FINER, COLUMNS, FINER).mean(axis=(1, 3)).round().astype(np.uint8)


def poses() -> list[Pose]:
    return [Pose.from_arrays(cv2.Rodrigues(np.array(r))[0], np.array(t)) for r, t in POSES]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("boards")
    for number, pose in enumerate(poses()):
        cv2.imwrite(str(made / f"left_{number}.png"), picture(pose))
        cv2.imwrite(str(made / f"right_{number}.png"), picture(compose(BASE, pose)))
    for file in made.iterdir():
        os.utime(file, (1.7e9, 1.7e9))
    return made


@pytest.fixture
def home(tmp_path: Path) -> Path:
    initialised(tmp_path / "home")
    return tmp_path / "home"


NAMES = ("--pattern", "{camera}_{state}.png", "--cameras", "left=C1 right=C2")
NEW = ("--rig", "pair", "--chessboard", "6x5", "--pitch-mm", "10")


def boards(folder: Path, home: Path, *options: str, code: int = 0) -> Any:
    done = CliRunner().invoke(
        app, ["boards", str(folder), "-c", "june", "--home", str(home), "--json", "--yes", *options]
    )
    if isinstance(done.exception, SmsError):
        raise done.exception
    assert done.exit_code == code, (done.exception, done.stderr)
    return json.loads(done.stdout)


def outcomes(told: Any) -> set[str]:
    return {t["outcome"] for t in told["tuples"]}


def session_of(home: Path) -> Campaign:
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        return campaigns.definition(campaigns.campaign_row(session, "june"))


def test_a_folder_of_boards_becomes_a_session_once(folder: Path, home: Path) -> None:
    assert outcomes(boards(folder, home, *NAMES, *NEW, "--dry-run")) == {"would be imported"}
    assert outcomes(boards(folder, home, *NAMES, *NEW, "--only", "*_[0-4].png")) == {"imported"}
    made = session_of(home)
    assert made.session is not None
    assert made.session.artefacts == {"board": BOARD}
    assert made.session.sensors == (SensorFormat("C1", COLUMNS, ROWS), SensorFormat("C2", COLUMNS, ROWS))
    assert made.views == ("C1", "C2")
    assert [(s.label, s.artefact) for s in made.states] == [(str(k), "board") for k in range(5)]
    # A calibration holds from its first image on.
    assert made.states[0].time is not None
    assert made.states[0].time.timestamp() == 1.7e9
    with pytest.raises(SmsError, match="no pose 5: set `add_states`"):
        boards(folder, home, *NAMES)
    told = boards(folder, home, *NAMES, "--add-states")
    assert [t["outcome"] for t in told["tuples"]] == ["already there"] * 10 + ["imported"] * 2
    assert session_of(home).states[5].artefact == "board"


def observed(folder: Path, cameras: dict[str, str]) -> SessionInMemory:
    """Return a session of the folder's images, by the cameras' names in it, whose boards are found."""
    sensors = [SensorFormat(name, COLUMNS, ROWS) for name in cameras]
    labels = [str(k) for k in range(len(POSES))]
    made = SessionInMemory(session_of_boards("june", "pair", BOARD, dict.fromkeys(labels, AT), sensors, None))
    for subject in every_view(made.campaign, board_states(made.campaign)):
        name = f"{cameras[subject.view or '']}_{subject.state}.png"
        image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        stack = ArrayStack(image[None])
        told = Measurement(AT, FringeSequence(), 255, 0.02, 0.5, image.astype(np.uint16), stack)
        made.records[MEASUREMENT, str(subject)] = {"measurement": told}
        made.run(observe_board, subject)
    return made


def test_two_cameras_are_found_as_they_stand(folder: Path) -> None:
    made = observed(folder, {"C1": "left", "C2": "right"})
    seen: BoardObservation = made.observation(OBSERVE_BOARD, "1", "C2")
    assert (seen.camera, seen.projector, len(seen.point)) == ("C2", "", BOARD.columns * BOARD.rows)
    # The corners as they were drawn; 30 grey levels of 8 bit tell an edge to some hundredths of a pixel.
    at = project(LENS, compose(BASE, poses()[1]), seen.point)
    assert np.abs(seen.camera_px - at).max() < 0.1
    found = made.run(calibrate_boards, Subject("june"), folds=2, figure_width_px=400)
    quality: CalibrationQuality = found["quality"]
    assert quality.views == ("C1C2",)
    assert np.isfinite(quality.expected_sigma).any()
    calibration: Calibration = found["calibration"]
    assert calibration.valid_from == AT
    first, second = calibration.rig.sensors
    assert measuring_pairs(calibration.rig) == [("C1", "C2")]
    deviation = np.sqrt(np.diag(found["uncertainty"].covariance))
    for number, sensor in enumerate((first, second)):
        # Of 18 parameters some are off by two or three of their standard deviations, none by five.
        assert abs(sensor.intrinsics.fx - LENS.fx) < 5.0 * deviation[PER_SENSOR * number + 6]
        assert abs(sensor.intrinsics.cy - LENS.cy) < 5.0 * deviation[PER_SENSOR * number + 9]
    # The world is the first board, whose frame keeps the pitch to 1/1000: 0.06 of 60 mm, and noise.
    base = np.linalg.norm(second.pose.centre() - first.pose.centre())
    assert base == pytest.approx(np.linalg.norm(BASE.translation), abs=5.0 * quality_of_base(quality))


def quality_of_base(quality: CalibrationQuality) -> float:
    """Return the expected deviation of a point, mm, as a measure of how far a sensor may be off."""
    return float(np.nanmedian(quality.expected_sigma))


def test_one_camera_has_lenses_and_no_pairs(folder: Path) -> None:
    made = observed(folder, {"C1": "left"})
    found = made.run(calibrate_boards, Subject("june"), folds=2, figure_width_px=400)
    assert found["quality"].views == ()
    (sensor,) = found["calibration"].rig.sensors
    deviation = np.sqrt(np.diag(found["uncertainty"].covariance))
    assert abs(sensor.intrinsics.fx - LENS.fx) < 5.0 * deviation[6]
    with pytest.raises(InvalidInput, match="one sensor, which alone measures no points"):
        measuring_pairs(found["calibration"].rig)
    # The box around all points of all boards, the first of which is the world: 50 x 40 mm of it.
    low, high = np.array(found["calibration"].volume.low), np.array(found["calibration"].volume.high)
    assert (low <= 0.0).all()
    assert high[0] >= 50.0
    assert high[1] >= 40.0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('shape = "circle-board"\ncolumns = 4\nrows = 3\npitch_mm = 5.0\ndot_diameter_mm = 6.0\n', "overlap"),
        ('shape = "ball-bar"\nlength_mm = 3.0\n', "shape"),
        ('shape = "chessboard"\ncolumns = 4\nrows = 3\n', "pitch_mm"),
        ('shape = "chessboard"\ncolumns = 4\nrows = 3\npitch_mm = 5.0\nside = 2\n', "side"),
        ("shape = [", "is not valid TOML"),
    ],
)
def test_a_board_that_cannot_be_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    (tmp_path / "board.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SmsError, match=complaint):
        load_board(tmp_path / "board.toml")


def test_a_board_without_markers_is_a_board(tmp_path: Path) -> None:
    text = 'shape = "circle-board"\ncolumns = 10\nrows = 8\npitch_mm = 25.0\ndot_diameter_mm = 15.0\n'
    (tmp_path / "board.toml").write_text(text, encoding="utf-8")
    assert load_board(tmp_path / "board.toml") == CircleBoard(10, 8, 25.0, 15.0)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ((*NAMES, "--rig", "pair"), "describe it with `board`"),
        ((*NAMES, *NEW[2:]), "name the `rig`"),
        ((*NAMES, *NEW, "--board", "x.toml"), "not by both"),
        ((*NAMES, "--rig", "pair", "--chessboard", "6 by 5"), "inner corners"),
        ((*NAMES, "--rig", "pair", "--chessboard", "6x5"), "give `pitch_mm`"),
        ((*NEW, "--cameras", "left=1"), "say which camera is which"),
        ((*NEW, "--cameras", "left=C1 right=C1"), "name C1 twice"),
        ((*NAMES[:2], *NEW), "fits the pattern"),
        ((*NAMES, *NEW, "--only", "gone_*"), "correct `only`"),
        ((*NAMES, *NEW, "--volume", "0", "0", "0", "0", "1", "1"), "lower corner"),
        (("--pattern", "left_{number}.png", *NEW), "has to have"),
    ],
)
def test_what_cannot_become_a_session_changes_nothing(
    folder: Path, home: Path, options: tuple[str, ...], complaint: str
) -> None:
    with pytest.raises(SmsError, match=complaint):
        boards(folder, home, *options)
    with bootstrap.services(home) as services:
        assert not list(services.archive.files())


def test_expected_deviations_are_drawn_where_few_places_are_seen() -> None:
    # Three places on one line, and one by itself, enclose no area.
    place = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [2.0, 2.0, 1.0], [0.0, 0.0, 2.0]])
    assert draw_expected_sigma(place, np.array([1.0, 2.0, 3.0, 4.0]), "C1P1", 400).startswith(b"\x89PNG")


def test_images_of_another_size_are_refused(folder: Path, home: Path, tmp_path: Path) -> None:
    boards(folder, home, *NAMES, *NEW, "--only", "*_[0-3].png")
    for side in ("left", "right"):
        image = cv2.imread(str(folder / f"{side}_4.png"), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(tmp_path / f"{side}_4.png"), cv2.resize(image, (COLUMNS // 2, ROWS // 2)))
    told = boards(tmp_path, home, *NAMES, "--only", "*_4.png", "--add-states", code=6)
    assert outcomes(told) == {"refused"}
    assert "160 x 120 px, but the session says that C1 has 320 x 240" in told["tuples"][0]["detail"]
    assert len(session_of(home).states) == 4
