"""Points of boards that other programs have found: a table becomes the observations of a session."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text
from support.archives import Clock, run_jobs, work_again
from support.command import inside
from support.homes import initialised
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.app.calibrating.calibrations import certify
from sms_jobs.catalogue import campaigns, schema
from sms_jobs.catalogue.tables.every import METADATA
from sms_jobs.cli.importing.group import app
from sms_jobs.errors import SmsError
from sms_jobs.formats.importers.board_points import (
    CAMERA_COLUMNS,
    PLACE_COLUMNS,
    PROJECTOR_COLUMNS,
    read_points,
)
from sms_jobs.jobs.archiving.calibrations import session_result
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.rebuilding.reindexing import reindex, unknown_files
from sms_jobs.kinds.products import BOARD
from sms_jobs.metrology.geometry.camera import Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix
from sms_jobs.records.artefacts import Chessboard

HEADER = ",".join(PLACE_COLUMNS + CAMERA_COLUMNS + PROJECTOR_COLUMNS) + "\n"
SIZES = ("--size", "C1=640x480", "--size", "P1=800x600")
GRID = [(float(x), float(y)) for y in (0, 75, 150) for x in (0, 75, 150, 225)]


def table(rows: list[tuple[str, float, float, float, float, float, float]]) -> str:
    return HEADER + "".join(",".join(map(str, row)) + "\n" for row in rows)


def usual() -> list[tuple[str, float, float, float, float, float, float]]:
    """Return two poses of a grid of 4 x 3 points, of which the second lacks one."""
    rows = [(pose, x, y, x + 10.0, y + 20.0, 2.0 * x, 2.0 * y) for pose in ("A", "B") for x, y in GRID]
    return rows[:-1]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "points.csv").write_text(table(usual()), encoding="utf-8")
    return tmp_path / "points.csv"


def test_a_table_is_read_as_it_is(file: Path) -> None:
    found = read_points(file, "C1P1", 0.2)
    assert found.board == Chessboard(4, 3, 75.0)
    assert [len(of_pose["C1P1"].point) for of_pose in found.observations.values()] == [12, 11]
    seen = found.observations["A"]["C1P1"]
    np.testing.assert_array_equal(seen.point[:, :2], GRID)
    np.testing.assert_array_equal(seen.place * 75.0, GRID)
    np.testing.assert_array_equal(seen.projector_px, 2.0 * np.array(GRID))
    assert (seen.projector_sigma_px == 0.2).all()
    alone = read_points(file, "C1", 0.2).observations["A"]["C1"]
    assert alone.projector == ""
    assert np.isnan(alone.projector_px).all()


def test_points_stand_where_a_job_would_have_put_them(file: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    initialised(home)
    options = ["points", str(file), "-c", "june", "--rig", "desk", "--view", "C1P1", *SIZES, "--json"]
    done = CliRunner().invoke(app, [*options, "--home", str(home)])
    assert done.exit_code == 0, done.exception
    assert json.loads(done.stdout)["points"] == {"A": 12, "B": 11}
    with bootstrap.services(home) as services:
        assert len(list(services.archive.files())) == 3
        with services.catalogue.reading() as session:
            campaign = campaigns.definition(campaigns.campaign_row(session, "june"))
        assert campaign.states[0].artefact == "board"
        (path,) = (p for p in services.archive.files() if "/A/" in p)
        with services.archive.open_unrecorded(path) as dataset:
            assert len(dataset.read(BOARD.name, BOARD.record).point) == 12
        # The archive alone tells all of it again.
        METADATA.drop_all(services.catalogue.engine)
        with services.catalogue.writing() as session:
            session.execute(text("DROP TABLE IF EXISTS alembic_version"))
        schema.upgrade(services.catalogue)
        files = unknown_files(services.catalogue, services.archive)
        done_again = list(reindex(services.catalogue, services.archive, files))
        assert [one.outcome for one in done_again] == ["indexed"] * 3, done_again


def two_cameras(lacking: set[tuple[str, str]]) -> str:
    """Return five poses of a board before two cameras; some poses are missing in one of these."""
    cameras = {
        name: (
            Intrinsics(900.0, 900.0, 319.5, 239.5),
            Pose.looking_at(np.array([at, 0.0, -600.0]), np.zeros(3), np.array([0.0, -1.0, 0.0])),
        )
        for name, at in (("C1", -150.0), ("C2", 150.0))
    }
    lines = ["state,board_x_mm,board_y_mm,C1_x_px,C1_y_px,C2_x_px,C2_y_px"]
    board = np.array([(x, y, 0.0) for y in range(0, 161, 40) for x in range(0, 241, 40)])
    turns = {
        "A": (0.0, 0.0, 0.0),
        "B": (0.5, 0.1, 0.2),
        "C": (-0.2, 0.6, 1.5),
        "D": (-0.5, -0.4, 0.3),
        "E": (0.4, -0.6, -0.5),
    }
    for pose, turn in turns.items():
        points = (board - [120.0, 80.0, 0.0]) @ rotation_matrix(np.array(turn)).T
        images = {name: project(*camera, points) for name, camera in cameras.items()}
        for k, (x, y, _) in enumerate(board):
            cells = [
                "," if (pose, n) in lacking else ",".join(map(repr, images[n][k].tolist())) for n in images
            ]
            lines.append(",".join([pose, repr(float(x)), repr(float(y)), *cells]))
    return "\n".join(lines) + "\n"


def test_points_of_two_cameras_calibrate_both(tmp_path: Path) -> None:
    file, home = tmp_path / "points.csv", tmp_path / "home"
    file.write_text(two_cameras({("D", "C2")}), encoding="utf-8")
    initialised(home)
    sizes = ("--size", "C1=640x480", "--size", "C2=640x480", "--sigma-px", "0.02")
    options = ["points", str(file), "-c", "june", "--rig", "desk", "--view", "C1C2", *sizes, "--json"]
    done = CliRunner().invoke(app, [*options, "--home", str(home)])
    assert done.exit_code == 0, done.exception
    counts = json.loads(done.stdout)["points"]
    assert counts == {f"{pose}/{camera}": 35 for pose in "ABCE" for camera in ("C1", "C2")} | {
        "D/C1": 35,
        "D/C2": 0,
    }
    with bootstrap.services(home) as services:
        work_again(services.catalogue, clock := Clock())
        run_jobs(services.catalogue, services.archive, clock, [Request("calibrate-boards")], "june")
        _, found = session_result(services.catalogue, services.archive, "june")
    first, second = (found.calibration.rig.sensor(name).pose for name in ("C1", "C2"))
    # Exact images of cameras 300 mm apart, as doubles: what is left is where the iterations stop.
    assert np.linalg.norm(first.centre() - second.centre()) == pytest.approx(300.0, rel=1e-4)
    assert found.calibration.rig.sensor("C2").intrinsics.fx == pytest.approx(900.0, rel=1e-4)


def test_what_speaks_against_a_calibration_is_shown_in_words(tmp_path: Path) -> None:
    file, home = tmp_path / "points.csv", tmp_path / "home"
    rows = [row for row in two_cameras(set()).splitlines() if not row.startswith("E,")]
    twice = [row.replace("D,", "E,", 1) for row in rows if row.startswith("D,")]
    file.write_text("\n".join([*rows, *twice]) + "\n", encoding="utf-8")
    initialised(home)
    sizes = ("--size", "C1=640x480", "--size", "C2=640x480", "--sigma-px", "0.02")
    options = ["points", str(file), "-c", "june", "--rig", "desk", "--view", "C1C2", *sizes]
    assert CliRunner().invoke(app, [*options, "--home", str(home)]).exit_code == 0
    with bootstrap.services(home) as services:
        work_again(services.catalogue, clock := Clock())
        run_jobs(services.catalogue, services.archive, clock, [Request("calibrate-boards")], "june")
        number = certify(services, "june", despite_warnings=True).number
    shown = inside("calibration", "show", str(number), "--home", str(home))
    assert shown.returncode == 0, shown.stderr
    assert "warning: poses D and E are one picture" in shown.stderr


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda old: old.replace("board_y_mm", "Y"), "has no column board_y_mm"),
        (lambda old: old.replace("75.0", "80.0", 1), "no square grid"),
        (lambda old: old + "A,0.0,0.0,1,1,1,1\n", "point of pose A twice"),
        (lambda old: old + "C,0.0,0.0,nan,1,1,1\n", "'nan' in column 'camera_x_px'"),
        (lambda old: old + "C,0.0,0.0,1,1\n", "'' in column 'projector_x_px'"),
        (lambda old: old + "a b,0.0,0.0,1,1,1,1\n", "cannot be the name of a state"),
        (lambda old: HEADER, "a header and no row"),
        (lambda old: "", "has no column"),
    ],
)
def test_a_table_that_is_wrong_is_refused(file: Path, change: object, complaint: str) -> None:
    assert callable(change)
    file.write_text(change(file.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(SmsError, match=complaint):
        read_points(file, "C1P1", 0.1)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("--view", "C1P1", "--size", "C1=640x480"), "give the image `size` of C1 and P1"),
        (("--view", "C1P1", "--size", "C1=640"), "--size should be as in"),
        (("--view", "P1", *SIZES), "'P1' is not a view"),
        (
            ("--view", "C1P1", "--size", "C1=200x480", "--size", "P1=800x600"),
            "C1 of pose A has 3 points outside of its image of 200 x 480 px, such as (235, 20)",
        ),
        (
            ("--view", "C1P1", "--size", "C1=640x480", "--size", "P1=800x200"),
            "P1 of pose A has 4 points outside of its image of 800 x 200 px, such as (0, 300)",
        ),
        (("--view", "C1C2P1", *SIZES), "the view C1C2P1 calibrates no projector: import the points of C1C2,"),
        (
            ("--view", "C1C2", "--size", "C1=9x9", "--size", "C2=9x9"),
            "has no column C1_x_px, C1_y_px, C2_x_px",
        ),
    ],
)
def test_options_that_contradict_are_refused(
    file: Path, tmp_path: Path, options: tuple[str, ...], complaint: str
) -> None:
    initialised(tmp_path / "home")
    done = CliRunner().invoke(
        app, ["points", str(file), "-c", "june", "--rig", "desk", *options, "--home", str(tmp_path / "home")]
    )
    assert isinstance(done.exception, SmsError)
    assert complaint in str(done.exception)
    with bootstrap.services(tmp_path / "home") as services:
        assert not list(services.archive.files())
