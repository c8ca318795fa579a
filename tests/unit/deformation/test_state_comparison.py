"""`sms campaign exact` writes what `sms data compare-states` subtracts: the commands, from file to table."""

from __future__ import annotations

import csv
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.homes import make_home, stored
from support.sessions import small_session
from typer.testing import CliRunner

from sms_jobs import bootstrap
from sms_jobs.cli.app import app
from sms_jobs.errors import Conflict, InvalidInput, NotFound, SmsError
from sms_jobs.formats.other_fields import read_point_field
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.fields import Mesh
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.exact_meshes import exact_mesh

OFF_BY = np.array([0.003, 0.0, -0.004])
SIGMA_MM = 0.002
VALUES = tuple(f"displacement {axis}" for axis in "XYZ")


def run(home: Path, *arguments: str) -> Any:
    done = CliRunner().invoke(app, [*arguments, "--home", str(home), "--json"])
    if isinstance(done.exception, SmsError):
        raise done.exception
    assert done.exit_code == 0, (done.exception, done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture
def home(home: Path) -> Path:
    """A home whose only merged result is the exact displacement, and besides that off by a translation."""
    make_home(home, {})
    exact = exact_mesh(small_plate("plate")[1], "S01", step_px=8)
    values = np.vstack([(exact.displacement + OFF_BY).T, np.full(len(exact.nodes), SIGMA_MM)])
    units = ("mm",) * len(values)
    mesh = Mesh((*VALUES, "sigma of displacement"), units, exact.nodes, exact.triangles, values)
    with bootstrap.services(home) as services:
        stored(services, "merge", "plate/S01", {"mesh": mesh})
    return home


def model_of(home: Path, step_px: int = 8) -> Path:
    out = home / "model"
    run(home, "campaign", "exact", "plate", "--out", str(out), "--step-px", str(step_px))
    return out


def test_the_written_mesh_is_the_exact_displacement(home: Path) -> None:
    field = read_point_field(model_of(home) / "S01.vtu", None, 1.0)
    exact = exact_mesh(small_plate("plate")[1], "S01", step_px=8)
    np.testing.assert_array_equal(field.points, exact.nodes)
    np.testing.assert_array_equal(field.values, exact.displacement)
    with pytest.raises(Conflict, match=r"S01\.vtu already exists"):
        run(home, "campaign", "exact", "plate", "--out", str(home / "model"))


def test_in_a_session_nothing_is_displaced_from_state_to_state(home: Path, tmp_path: Path) -> None:
    session = small_session("session")
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, session, None, datetime.now(UTC))
    with pytest.raises(InvalidInput, match="session is a calibration session: an artefact is put before"):
        run(home, "campaign", "exact", "session", "--out", str(tmp_path / "model"))
    assert not (tmp_path / "model").exists()


def test_what_a_measurement_is_off_by_is_told_at_every_state(home: Path) -> None:
    files = str(model_of(home) / "{state}.vtu")
    (found,) = run(home, "data", "compare-states", "plate", "--with", files)
    assert (found["state"], found["load_n"], found["applied_mm"]) == ("S01", 1200.0, 0.75)
    # Both are double precision on the same nodes, the coordinates some hundred mm.
    for name in ("rms_mm", "rms_of_best_95_percent_mm", "largest_mm"):
        assert found[name] == pytest.approx(np.linalg.norm(OFF_BY), abs=1e-10)
    assert found["stated_mm"] == pytest.approx(SIGMA_MM)
    (free,) = run(home, "data", "compare-states", "plate", "--with", files, "--free-of-motion")
    assert free["largest_mm"] < 1e-10
    inches = ("--scale-mm", "25.4", "--within-mm", "0.5")
    with pytest.raises(InvalidInput, match="with `scale_mm`"):
        run(home, "data", "compare-states", "plate", "--with", files, *inches)


def test_a_model_of_other_nodes_is_interpolated(home: Path) -> None:
    files = str(model_of(home, step_px=3) / "{state}.vtu")
    (found,) = run(home, "data", "compare-states", "plate", "--with", files)
    # A stretched and turned plane moves linearly, and so does what is between nodes.
    assert found["largest_mm"] == pytest.approx(np.linalg.norm(OFF_BY), abs=1e-9)
    assert found["points"] > 100


def test_another_campaign_is_compared_by_its_name_and_the_table_is_written(home: Path) -> None:
    table, maps = home / "states.csv", home / "states.png"
    for out in (table, maps):
        told = run(home, "data", "compare-states", "plate", "--with", "plate", "--out", str(out))
        assert told[0]["largest_mm"] < 1e-12
        with pytest.raises(Conflict, match="set `force`"):
            run(home, "data", "compare-states", "plate", "--with", "plate", "--out", str(out))
    (row,) = csv.DictReader(table.read_text().splitlines())
    assert (row["state"], float(row["load_n"])) == ("S01", 1200.0)
    assert float(row["rms_mm"]) < 1e-12
    assert maps.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        (["plate", "--with", "nobody"], NotFound, "no campaign 'nobody'"),
        (["plate", "--with", "nowhere/{state}.vtu"], NotFound, "no state of plate has both"),
        (["plate", "--with", "plate", "--kind", "strain"], InvalidInput, "choose merge or combine"),
        (["plate", "--with", "plate", "--kind", "combine"], NotFound, "no state of plate has both"),
        (["plate", "--with", "plate", "--out", "states.pdf"], InvalidInput, r"\.csv"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    home: Path, arguments: list[str], error: type[SmsError], words: str
) -> None:
    with pytest.raises(error, match=words):
        run(home, "data", "compare-states", *arguments)
