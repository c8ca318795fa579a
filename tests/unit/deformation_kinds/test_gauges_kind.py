"""Virtual gauges on the stretched plate, from stored fields alone."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command import answer, inside
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.fields import surface_fields
from sms_jobs.app.fields.surface_fields import Gauges
from sms_jobs.cli import surface_places
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.profiles import GaugeRow, draw_gauges
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.archiving.repository import Repository, brought_in
from sms_jobs.kinds.deformation import gauges
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.kinds.kind import Inputs
from sms_jobs.kinds.products import GAUGES
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

ALONG, ACROSS, AWAY = (
    "along x=5 y=-10 length=40 width=30",
    "across x=5 y=-10 length=40 width=30 angle=90",
    "away x=500 y=0 length=10",
)


def test_gauges_read_the_strain_of_the_plate_in_its_own_frame(plate: Any) -> None:
    output = plate.run(
        gauges.KIND, plate.subject("S01", "C1P1"), GaugesParameters(gauge=(ALONG, ACROSS, AWAY))
    )
    found = output.records["gauges"]
    # 0.5 % and -0.15 %, Green-Lagrange; the plate's x axis is turned in the world.
    truth = np.array([0.005 + 0.5 * 0.005**2, -0.0015 + 0.5 * 0.0015**2])
    assert found.names == ("along", "across", "away")
    # Four standard deviations of a value that was predicted to about 20 %.
    assert (np.abs(found.strain[:2] - truth) < 5.0 * found.sigma[:2]).all()
    assert (found.sigma[:2] < 5e-4).all()
    np.testing.assert_allclose(found.place[:2, :2], [[5.0, -10.0]] * 2, atol=1.0)
    assert np.isnan(found.strain[2])
    assert output.statistics["gauges_read"] == 2.0


def test_a_gauge_that_reads_nothing_is_named(plate: Any) -> None:
    subject, chosen = plate.subject("S01", "C1P1"), GaugesParameters(gauge=(ALONG, AWAY))
    needs = gauges.KIND.checked_needs(plate.campaign, subject, chosen)
    inputs = Inputs(
        subject,
        gauges.KIND.context(plate.campaign, subject),
        {need.role: plate.find(need) for need in needs},
    )
    said: list[str] = []
    list(gauges.KIND.run(inputs, chosen, lambda fraction, words: said.append(words)))
    assert said[-1] == "note: nothing to read under away: off the specimen, or too few valid points"


def test_what_a_camera_alone_reads_in_pixels_is_no_gauge_of_a_surface(plate: Any) -> None:
    subject, alone = plate.subject("S01", "C1P1"), "C2 x=90px y=90px length=20px"
    both = plate.run(gauges.KIND, subject, GaugesParameters(gauge=(alone, ALONG))).records["gauges"]
    assert both.names == ("along",)
    with pytest.raises(InvalidInput, match="gauge 'C2' is in pixels"):
        plate.run(gauges.KIND, subject, GaugesParameters(gauge=(alone,)))


@pytest.mark.parametrize("length", ["400", "1e5", "1e300"])
def test_a_gauge_longer_than_the_surface_is_refused_whatever_it_would_take(plate: Any, length: str) -> None:
    chosen = GaugesParameters(gauge=(ALONG, f"long x=0 y=0 length={length} width=5"))
    with pytest.raises(
        InvalidInput, match=r"gauge long is .* mm long and 5 mm wide, and the surface of C1P1"
    ):
        plate.run(gauges.KIND, plate.subject("S01", "C1P1"), chosen)


def test_the_command_says_which_gauges_read_nothing_and_where(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    initialised(home)
    nothing = [GaugeRow(f"S0{k}", "C1P1", "away", None, None, 0) for k in (1, 2, 3)]
    found = Gauges(
        (GaugeRow("S01", "C1P1", "G1", 1e-4, 1e-5, 40), *nothing, replace(nothing[0], view="C2P1"))
    )
    monkeypatch.setattr(surface_fields, "gauges", lambda *words, **more: found)
    surface_places.gauges("plate", home=home)
    why = "it lies off the specimen, or fewer than twelve valid points lie under it"
    assert capsys.readouterr().err.splitlines() == [
        f"gauge away reads nothing in C1P1 at S01 and 2 more: {why}",
        f"gauge away reads nothing in C2P1 at S01: {why}",
    ]


@pytest.fixture
def read(home: Path) -> Path:
    """A home with what a gauge reads at three states, of which the last was computed first."""
    initialised(home)
    calibration, plate = small_plate("plate")
    rest, moved = plate.states
    states = (rest, *(replace(moved, label=label) for label in ("S9", "S10", "after")))
    now = datetime.now(UTC)
    with bootstrap.services(home) as services:
        ordered = replace(plate, states=states)
        register_campaign(services.catalogue, services.archive, ordered, calibration, now)
        one = GaugeReadings(
            "green-lagrange",
            ("G1",),
            np.zeros(1),
            np.zeros(1, np.float32),
            np.zeros((1, 3)),
            np.full(1, 40, np.int32),
        )
        with Repository(services.catalogue, services.archive).batch() as batch:
            for label in ("after", "S10", "S9"):
                batch.seal(
                    {GAUGES.stored_as: one}, brought_in("gauges", Subject("plate", label, "C1P1"), now)
                )
            batch.enter()
    return home


def test_readings_are_in_the_order_of_the_test(read: Path) -> None:
    with bootstrap.services(read) as services:
        found = surface_fields.gauges(services, "plate")
    assert [row.state for row in found.rows] == ["S9", "S10", "after"]


def test_readings_of_no_state_and_no_gauge_are_told_and_left_out(read: Path, tmp_path: Path) -> None:
    file = tmp_path / "real.csv"
    words = ("data", "gauges", "-c", "plate", "--readings", str(file), "--home", str(read))
    no_state = (
        "1 reading at state s9, which campaign plate does not have; did you mean 'S9'; "
        "'sms campaign show plate' shows its own"
    )
    no_gauge = (
        "2 readings of gauge SG1, which is no virtual gauge of campaign plate; did you mean 'G1'; it has G1"
    )
    file.write_text("state,gauge,microstrain\nS9,G1,10\ns9,G1,10\nS9,SG1,5\nS10,SG1,5\nS00,G1,0\n")
    done = inside(*words)
    assert done.returncode == 0
    assert done.stderr.splitlines()[:2] == [f"left out: {no_state}", f"left out: {no_gauge}"]
    assert "rms difference of 1 reading: 10.0 microstrain" in done.stderr
    assert answer(*words)["left_out"] == [no_state, no_gauge]
    file.write_text("state,gauge,microstrain\nS9,SG1,5\nS10,SG1,5\n")
    refused = inside(*words)
    assert refused.returncode == 2
    assert f"no reading of gauge file {file} can be compared: {no_gauge}" in refused.stderr


def test_gauges_are_drawn() -> None:
    rows = [GaugeRow(f"S0{k}", "C1P1", "G1", 1e-4 * k, 1e-5, 9, 1.1e-4 * k, 1e-5 * k) for k in (1, 2)]
    assert draw_gauges(rows).startswith(b"\x89PNG")
