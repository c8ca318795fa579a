"""What a table of readings is taken to say, where another reading of it would be a wrong number."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.readings import Column, read_table, states_by_time

GAUGES = "um/m"


@pytest.mark.parametrize(
    ("header", "value", "name", "strain"),
    [
        ("SG1", 1200.0, "sg1", 1.2e-3),
        ("SG1 [%]", 0.12, "sg1", 1.2e-3),
        ("SG1 (%)", 0.12, "sg1", 1.2e-3),
        ("SG1 (mm/m)", 1.2, "sg1", 1.2e-3),
        ("SG1 (µm/m)", 1200.0, "sg1", 1.2e-3),
        ("SG (1)", 1200.0, "sg_1", 1.2e-3),
        ("SG1 (strain)", 1200.0, "sg1_strain", 1.2e-3),
        ("SG1 (front)", 1200.0, "sg1_front", 1.2e-3),
    ],
)
def test_a_unit_in_brackets_of_a_header_counts_before_the_usual_one(
    header: str, value: float, name: str, strain: float
) -> None:
    column = Column.named_by(header, GAUGES)
    assert (column.target, column.scaled(value)) == (name, pytest.approx(strain, rel=1e-12))
    mapped = Column.parse(header, "gauge_1", GAUGES)
    assert (mapped.target, mapped.scaled(value)) == ("gauge_1", pytest.approx(strain, rel=1e-12))


@pytest.mark.parametrize("header", ["SG1 %", "SG1 mm/m", "Dehnung in %", "SG1_µm", "Kraft/kN"])
def test_a_unit_outside_of_brackets_is_asked_for(header: str) -> None:
    for made in (lambda: Column.named_by(header, GAUGES), lambda: Column.parse(header, "gauge_1", GAUGES)):
        with pytest.raises(InvalidInput, match="may say a unit that is not in brackets"):
            made()
    assert Column.parse(header, "gauge_1[%]", GAUGES).factor == 1e-2


def test_what_a_column_is_mapped_to_counts_before_its_header() -> None:
    assert Column.parse("SG1 [%]", "gauge_1[mm/m]", GAUGES).factor == 1e-3
    assert Column.parse("Force [N]", "load[kN]").factor == 1e3


@pytest.mark.parametrize(
    ("header", "target", "factor"),
    [
        ("Force [kN]", "load_n", 1e3),
        ("Force (kN)", "load_n", 1e3),
        ("Force [kN]", "load", 1e3),
        ("Force", "load_n", 1.0),
        ("Way [um]", "displacement_mm", 1e-3),
        ("Way (front)", "displacement_mm", 1.0),
    ],
)
def test_a_load_has_the_unit_of_its_header_if_the_map_has_none(
    header: str, target: str, factor: float
) -> None:
    assert Column.parse(header, target).factor == factor


@pytest.mark.parametrize(
    ("unit", "factor"), [("mN", 1e-3), ("MN", 1e6), ("KN", 1e3), ("kn", 1e3), ("n", 1.0)]
)
def test_a_millinewton_is_no_meganewton(unit: str, factor: float) -> None:
    assert Column.parse("F", f"load[{unit}]").factor == factor


@pytest.mark.parametrize("unit", ["mn", "Mn"])
def test_a_unit_with_two_meanings_is_refused(unit: str) -> None:
    with pytest.raises(InvalidInput, match="give one of N, kN, MN, mN"):
        Column.parse("F", f"load[{unit}]")


def test_a_point_beside_decimal_commas_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text("state;F\n0;1.234\n1;2,5\n")
    table = read_table(file, decimal=",")
    assert table.number(1, 1) == 2.5
    with pytest.raises(InvalidInput, match=r"line 2: '1\.234' in column 'F' is no finite number"):
        table.number(0, 1)


def test_rows_of_one_time_are_told(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    # The hour is there twice, when summer time ends.
    times = ("2024-10-27T02:30:00", "2024-10-27T02:31:00", "2024-10-27T02:30:00")
    file.write_text("time,F\n" + "".join(f"{time},{k}\n" for k, time in enumerate(times)))
    at = {
        "S00": datetime(2024, 10, 27, 0, 30, tzinfo=UTC),
        "S01": datetime(2024, 10, 27, 0, 31, tzinfo=UTC),
    }
    states, left_out = states_by_time(
        read_table(file), 0, at, ZoneInfo("Europe/Berlin"), timedelta(seconds=2)
    )
    assert states == ["S00", "S01", None]
    assert left_out == [
        "state S00: 2 rows have the time nearest to it, that of line 2 counts and that of line 4 does not"
    ]
