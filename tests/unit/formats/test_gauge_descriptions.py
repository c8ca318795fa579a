"""Gauges as people write them."""

from __future__ import annotations

from math import pi
from pathlib import Path

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.gauge_descriptions import described_gauge, gauge_from, read_gauge_file
from sms_jobs.formats.profiles import GaugeRow, compared
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.metrology.deformation.strain.gauges import GaugePlace


def test_a_gauge_is_read_with_its_defaults() -> None:
    assert gauge_from("G1 x=10 y=-20 length=6") == ("G1", GaugePlace(10.0, -20.0, 6.0, 3.0, 0.0))
    name, place = gauge_from("top y=0 x=1.5 width=2 angle=90 length=4")
    assert (name, place.width) == ("top", 2.0)
    assert place.angle_rad == pytest.approx(pi / 2)


@pytest.mark.parametrize(
    "text", ["G1", "G1 x=1 y=2", "x=1 y=2 length=3", "G1 x=a y=1 length=2", "G1 x=1 y=1 length=0", "G1 x=nan"]
)
def test_a_gauge_that_cannot_be_understood_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput, match="write NAME x=MM"):
        gauge_from(text)


def test_a_gauge_in_pixels_is_for_a_camera_alone() -> None:
    found = described_gauge("G1 x=450px y=80px length=60px width=20px angle=90")
    assert (found.name, found.unit) == ("G1", "px")
    assert found.place == GaugePlace(450.0, 80.0, 60.0, 20.0, pi / 2)
    assert described_gauge("G1 x=1mm y=2mm length=3mm") == described_gauge("G1 x=1 y=2 length=3")
    with pytest.raises(InvalidInput, match="on a surface write NAME x=MM"):
        gauge_from("G1 x=450px y=80px length=60px")


def test_several_gauges_come_in_one_text_or_in_many() -> None:
    one = GaugesParameters(gauge="A x=0 y=0 length=2; B x=1 y=1 length=2")  # type: ignore[arg-type]
    assert one == GaugesParameters(gauge=("A x=0 y=0 length=2", "B x=1 y=1 length=2"))
    with pytest.raises(ValueError, match="two gauges have one name"):
        GaugesParameters(gauge=("A x=0 y=0 length=2", "A x=1 y=1 length=2"))


def test_real_gauges_stand_beside_virtual_ones(tmp_path: Path) -> None:
    file = tmp_path / "gauges.csv"
    file.write_text("gauge, state, microstrain\nG1, S01, 512.5\nG9, S01, 3\n", encoding="utf-8")
    rows = [GaugeRow("S01", "C1P1", "G1", 5e-4, 1e-5, 40), GaugeRow("S02", "C1P1", "G1", None, None, 0)]
    first, second = compared(rows, read_gauge_file(file))
    assert first.real == pytest.approx(512.5e-6)
    assert first.difference == pytest.approx(-12.5e-6)
    assert (second.real, second.difference) == (None, None)
    with pytest.raises(InvalidInput, match="no reading of the gauge file"):
        compared(rows[1:], read_gauge_file(file))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("state,gauge\nS01,G1\n", "no column microstrain"),
        ("state,gauge,microstrain\nS01,G1,x\n", "line 2"),
        ("state,gauge,microstrain\nS01,G1,nan\n", "line 2"),
        (
            "state,gauge,microstrain\nS01,G1,1\nS01,G2,2\nS01,G1,3\n",
            "line 4 .* second of gauge G1 at state S01",
        ),
    ],
)
def test_a_wrong_gauge_file_is_refused(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "gauges.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidInput, match=complaint):
        read_gauge_file(file)
