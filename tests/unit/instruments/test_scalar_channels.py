"""Scalars: a column of a growing file, and records of text protocols."""

from __future__ import annotations

import os
import tomllib
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sms_jobs.errors import DeviceFault, InvalidInput, LinkLost
from sms_jobs.instruments.clock import RealClock, SimulatedClock
from sms_jobs.instruments.codecs.scalars import reported_value
from sms_jobs.instruments.devices.connecting import Connector
from sms_jobs.instruments.devices.scalar_channels import ChannelValue, FileScalar
from sms_jobs.records.instruments import FileChannel, SerialChannel, TriggerController
from sms_jobs.records.serial_links import Fault, LineProtocol, SerialLink, Wire

NOW = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "frame.csv"
    path.write_text("Time,Axial Force (kN),Stroke\n0.0,1954.0,1.5\n0.1,1955.25,1.6\n")
    os.utime(path, (NOW.timestamp(), NOW.timestamp()))
    return path


def channel(path: Path, column: str = "Axial Force (kN)") -> FileChannel:
    return FileChannel("load", str(path), column, "N", scale=1000.0)


def at(path: Path, seconds: float, **changes: object) -> FileScalar:
    clock = SimulatedClock(started=NOW + timedelta(seconds=seconds))
    return FileScalar(replace(channel(path), **changes), clock)  # type: ignore[arg-type]


def test_the_last_line_of_a_growing_file(table: Path) -> None:
    scalar = at(table, 2.0)
    scalar.connect()
    [reading] = scalar.read()
    assert (reading.value, reading.unit) == (1_955_250.0, "N")
    assert reading.time == NOW
    # A line that is still being written does not count.
    with table.open("a") as file:
        file.write("0.2,19")
    os.utime(table, (NOW.timestamp(), NOW.timestamp()))
    assert ChannelValue(scalar).read() == 1_955_250.0
    with table.open("a") as file:
        file.write("50.0,1.7\n")
    os.utime(table, (NOW.timestamp(), NOW.timestamp()))
    assert scalar.reading().value == 1_950_000.0


def test_a_long_file_is_read_from_its_end(table: Path) -> None:
    with table.open("a") as file:
        file.writelines(f"{k},{k}.5,0\n" for k in range(50_000))
    os.utime(table, (NOW.timestamp(), NOW.timestamp()))
    assert at(table, 1.0).reading().value == 49_999_500.0


def test_a_file_that_is_not_written_any_more_is_no_reading(table: Path) -> None:
    with pytest.raises(LinkLost, match=r"was last written 7 s ago, more than 5 s"):
        at(table, 7.0).connect()
    assert at(table, 7.0, stale_after_s=0.0).reading().value == 1_955_250.0


def test_what_is_wrong_with_a_file_is_said(table: Path) -> None:
    with pytest.raises(DeviceFault, match=r"has no column 'Load': it has Time, Axial Force \(kN\), Stroke"):
        at(table, 1.0, column="Load").connect()
    with pytest.raises(LinkLost, match="cannot be read"):
        at(table.with_name("other.csv"), 1.0).connect()
    table.write_text("Time,Axial Force (kN)\n0.0,overload\n")
    os.utime(table, (NOW.timestamp(), NOW.timestamp()))
    with pytest.raises(LinkLost, match="no number in column"):
        at(table, 1.0).connect()
    table.write_text("Time,Axial Force (kN)\n")
    os.utime(table, (NOW.timestamp(), NOW.timestamp()))
    with pytest.raises(LinkLost, match="no number"):
        at(table, 1.0).connect()


def test_other_delimiters_decimals_and_columns_by_number(tmp_path: Path) -> None:
    path = tmp_path / "kraft.csv"
    path.write_text("Zeit;Kraft\n0,1;12,75\n", "utf-8")
    scalar = FileScalar(
        FileChannel("load", str(path), "2", "N", delimiter=";", decimal=",", stale_after_s=0.0), RealClock()
    )
    assert scalar.reading().value == 12.75
    path.write_text("0,1;12,75\n0,2;13,25\n", "utf-8")  # no headings at all
    assert scalar.reading().value == 13.25
    assert Connector(RealClock()).channel(FileChannel("a", str(path), "2", "N", delimiter=";")).name == "a"


@pytest.mark.parametrize(
    ("reply", "text", "value"),
    [
        (r"(?P<value>[-+]?\d+\.\d+) ?(?P<unit>\w+)", "ST,GS,+0012.50 kN", 12_500.0),
        (r"^F=(?P<value>-?\d+)(?P<unit>kN)$", "F=-3kN", -3_000.0),
        (r"(?P<value>\S+) (?P<unit>\S+)$", "nan kN", None),
        (r"(?P<value>\d+)(?P<unit>kN)$", "busy", None),
    ],
)
def test_a_value_in_a_reply(reply: str, text: str, value: float | None) -> None:
    load = SerialChannel(
        "load", SerialLink("simulated"), LineProtocol(), "N", "?", reply, reported_unit="kN", scale=1e3
    )
    assert reported_value(load, text) == value


def test_records_of_text_protocols_refuse_what_cannot_work() -> None:
    link, protocol = SerialLink("simulated"), LineProtocol()
    with pytest.raises(InvalidInput, match="cannot be read"):
        LineProtocol(accepted="(")
    with pytest.raises(InvalidInput, match="no group 'value'"):
        SerialChannel("load", link, protocol, "N", reply=r"\d+")
    for request in (
        "fire {channel}",
        "fire {output.__class__}",
        "fire {output!r}",
        "fire {output:999999999d}",
        "fire {",
    ):
        with pytest.raises(InvalidInput, match=r"only \{output\} is replaced"):
            TriggerController("box", link, protocol, (Wire("C1", 1),), request)
    with pytest.raises(InvalidInput, match="each to another sensor"):
        TriggerController("box", link, protocol, (Wire("C1", 1), Wire("C1", 2)), "fire")
    with pytest.raises(InvalidInput, match="has no axes"):
        TriggerController("box", link, protocol, (Wire("C1", 1),), "fire", faults=(Fault("tow-error"),))
    with pytest.raises(InvalidInput, match="times is 1 or more"):
        Fault("unplugged", at=0)
    with pytest.raises(InvalidInput, match="retries"):
        SerialLink("simulated", retries=-1)


def test_the_examples_of_the_documentation_are_valid() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "instruments.md").read_text("utf-8")
    blocks = [block.split("```")[0] for block in text.split("```toml\n")[1:]]
    protocols = [line for block in blocks for line in block.splitlines() if line.startswith("protocol")]
    assert len([LineProtocol(**tomllib.loads(line)["protocol"]) for line in protocols]) == 4
    faults = tomllib.loads(next(block for block in blocks if block.startswith("faults")))["faults"]
    assert len([Fault(**fault) for fault in faults]) == 4
