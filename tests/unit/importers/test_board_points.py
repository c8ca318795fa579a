"""Points of boards that other programs have found: a table becomes the observations of a session."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.catalogue import campaigns, schema
from sms_jobs.catalogue.models import Table
from sms_jobs.cli.importing import app
from sms_jobs.errors import SmsError
from sms_jobs.formats.importers.board_points import COLUMNS, PROJECTOR_COLUMNS, read_points
from sms_jobs.jobs.reindexing import reindex, unknown_files
from sms_jobs.kinds.products import BOARD
from sms_jobs.records.artefacts import Chessboard

HEADER = ",".join(COLUMNS + PROJECTOR_COLUMNS) + "\n"
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
    assert [len(seen.point) for seen in found.observations.values()] == [12, 11]
    seen = found.observations["A"]
    np.testing.assert_array_equal(seen.point[:, :2], GRID)
    np.testing.assert_array_equal(seen.place * 75.0, GRID)
    np.testing.assert_array_equal(seen.projector_px, 2.0 * np.array(GRID))
    assert (seen.projector_sigma_px == 0.2).all()
    alone = read_points(file, "C1", 0.2).observations["A"]
    assert alone.projector == ""
    assert np.isnan(alone.projector_px).all()


def test_points_stand_where_a_job_would_have_put_them(file: Path, tmp_path: Path) -> None:
    home = tmp_path / "home"
    bootstrap.initialise(home)
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
        Table.metadata.drop_all(services.catalogue.engine)
        with services.catalogue.writing() as session:
            session.execute(text("DROP TABLE IF EXISTS alembic_version"))
        schema.upgrade(services.catalogue)
        files = unknown_files(services.catalogue, services.archive)
        done_again = list(reindex(services.catalogue, services.archive, files))
        assert [one.outcome for one in done_again] == ["indexed"] * 3, done_again


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
        (("--view", "C1P1", "--size", "C1=640x480"), "give --size of C1 and P1"),
        (("--view", "C1P1", "--size", "C1=640"), "--size should be as in"),
        (("--view", "P1", *SIZES), "'P1' is not a view"),
    ],
)
def test_options_that_contradict_are_refused(
    file: Path, tmp_path: Path, options: tuple[str, ...], complaint: str
) -> None:
    bootstrap.initialise(tmp_path / "home")
    done = CliRunner().invoke(
        app, ["points", str(file), "-c", "june", "--rig", "desk", *options, "--home", str(tmp_path / "home")]
    )
    assert isinstance(done.exception, SmsError)
    assert complaint in str(done.exception)
    with bootstrap.services(tmp_path / "home") as services:
        assert not list(services.archive.files())
