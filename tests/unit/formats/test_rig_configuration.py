"""Rig files are read as they are written, and mistakes in them are named by line and key."""

from __future__ import annotations

from math import radians
from pathlib import Path

import pytest

from sms_jobs.errors import ConfigurationError, NotFound
from sms_jobs.formats import configuration
from sms_jobs.formats.rig_configuration import example_rig, load_rig, parse_rig
from sms_jobs.jobs.recording.lacking import lacking


def test_the_example_has_what_is_lacking_to_no_example_of_a_plan_that_names_it() -> None:
    rig = parse_rig(example_rig(), "rig.toml")
    plans = (configuration.example_campaign, configuration.example_session, configuration.example_stereo)
    campaigns = [configuration.parse_campaign(plan(), "plan").campaign for plan in plans]
    named = [one for one in campaigns if one.rig == rig.name]
    assert [one.session is not None for one in named] == [True]
    assert [lacking(rig, one, one.views) for one in named] == [[]]


def test_the_example_is_a_rig() -> None:
    rig = parse_rig(example_rig(), "rig.toml")
    assert rig.sensors == ("C1", "P1", "P2")
    assert rig.devices == ("C1", "P1", "P2", "load_n", "stage")
    assert rig.stage is not None
    assert (rig.stage.pan.module, rig.stage.tilt.module) == (12, 13)
    assert rig.stage.pan.minimum_rad == pytest.approx(radians(-120.0))
    assert rig.stage.tilt.acceleration_rad_s2 == pytest.approx(radians(120.0))
    # What is not said has the record's default, though angles are written in degrees.
    assert rig.stage.settling.tolerance_rad == pytest.approx(radians(0.01))
    assert rig.stage.link.baud_rate == 38400
    assert rig.serial.channels[0].unit == "N"


MISTAKES = [
    ("rows = 256", "rows = 2.5", "cameras[C1].rows should be a whole number, not 2.5"),
    ('"powercube"', '"powercub"', "stages[stage].protocol should be 'powercube'"),
    ("minimum_deg = -120.0", "minimum_deg = 20.0", "stages[stage].pan cannot be used: the range"),
    ("module = 13", "module = 12", "both axes of stage 'stage' have the address 12"),
    ("reported_unit", "reportedunit", "channels[load_n] has no key 'reportedunit'; its keys are name, link"),
    ('port = "simulated" }', 'prt = "simulated" }', "channels[load_n].link has no key 'prt'"),
    ("baud_rate = 38400", "baud_rate = 0", "0 baud"),
    ("velocity_deg_s = 60.0", "velocity_rad_s = 1.0", "stages[stage].tilt has no key 'velocity_rad_s'"),
    ('name = "P2"', 'name = "P1"', "two sensors of one name: C1, P1, P1"),
    ('name = "stage"', 'name = "../stage"', "cannot be the name of a stage"),
    ("(?P<value>", "(?P<number>", "has no group 'value'"),
]


@pytest.mark.parametrize(("old", "new", "message"), MISTAKES, ids=[m[1] for m in MISTAKES])
def test_a_mistake_is_named(old: str, new: str, message: str) -> None:
    text = example_rig()
    # The last place, where the first is in a comment or another instrument's.
    head, found, tail = text.rpartition(old)
    assert found
    with pytest.raises(ConfigurationError) as refused:
        parse_rig(head + new + tail, "rig.toml")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_line_of_a_mistake_is_named() -> None:
    text = example_rig()
    line = next(i for i, x in enumerate(text.splitlines(), start=1) if x.startswith("pan ="))
    with pytest.raises(ConfigurationError, match=rf"^rig\.toml, line {line}: stages\[stage\]\.pan\.module"):
        parse_rig(text.replace("module = 12", 'module = "12"'), "rig.toml")


def test_a_wire_to_nowhere_is_refused() -> None:
    box = """
[[triggers]]
name = "box"
link = { port = "simulated" }
protocol = {}
trigger = "T{output}"
wiring = [{ sensor = "C3", output = 1 }]
"""
    with pytest.raises(ConfigurationError, match="rig virtual wires C3, which it does not have"):
        parse_rig(example_rig() + box, "rig.toml")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"there is no rig file .*none\.toml"):
        load_rig(tmp_path / "none.toml")
    (tmp_path / "a.toml").write_text("name = ")
    with pytest.raises(ConfigurationError, match="is not valid TOML"):
        load_rig(tmp_path / "a.toml")
