"""Which cameras and projectors a rig file may describe, and which do not go together."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args, get_type_hints

import pytest

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.rig_configuration import SIMULATED_SENSORS, example_rig, parse_rig
from sms_jobs.instruments.optical_drivers import camera_drivers, projector_drivers
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.records.optical_instruments import CameraInstrument, VirtualCamera


@dataclass(frozen=True)
class Pinhole(CameraInstrument):
    """A camera that no driver of the program has."""

    driver: Literal["pinhole"]
    box_mm: float = 300.0
    line: str = ""

    @property
    def wired(self) -> bool:
        return self.line != ""


SENSORS = replace(SIMULATED_SENSORS, cameras={"pinhole": Pinhole, "simulated": VirtualCamera})
CAMERA = '[[cameras]]\nname = "C1"\ndriver = "pinhole"\ncolumns = 256\nrows = 256\n'
BOX = """
[[triggers]]
name = "box"
link = { port = "simulated" }
protocol = {}
trigger = "T{output}"
wiring = [{ sensor = "C1", output = 1 }]
"""


def test_what_a_driver_declares_can_be_written_and_nothing_else() -> None:
    rig = parse_rig('name = "hut"\n' + CAMERA + "box_mm = 200.0", "rig.toml", SENSORS)
    assert rig.cameras == (Pinhole("C1", 256, 256, "pinhole", 200.0),)
    with pytest.raises(ConfigurationError, match=r"line 2: cameras\[C1\] has no key 'bo_mm'.* box_mm"):
        parse_rig('name = "hut"\n' + CAMERA + "\nbo_mm = 200.0", "rig.toml", SENSORS)
    with pytest.raises(ConfigurationError, match=r"line 5: cameras\[C1\].columns should be a whole"):
        parse_rig('name = "hut"\n' + CAMERA.replace("columns = 256", "columns = 2.5"), "rig.toml", SENSORS)
    with pytest.raises(ConfigurationError, match=r"driver should be one of 'pinhole', 'simulated', not 'hol"):
        parse_rig('name = "hut"\n' + CAMERA.replace("pinh", "h"), "rig.toml", SENSORS)


def test_a_driver_is_found_by_its_module_alone() -> None:
    for drivers in (camera_drivers(), projector_drivers()):
        assert "simulated" in drivers
        for name, driver in drivers.items():
            assert get_args(get_type_hints(driver.record)["driver"]) == (name,)


def test_real_sensors_see_no_simulated_light() -> None:
    text = example_rig().replace('driver = "simulated"            # looks', 'driver = "pinhole" #')
    with pytest.raises(ConfigurationError, match="rig virtual has simulated sensors beside real ones"):
        parse_rig(text, "rig.toml", SENSORS)


def test_a_trigger_wire_has_two_ends() -> None:
    with pytest.raises(ConfigurationError, match="C1 of rig hut waits for a trigger by wire, but no"):
        parse_rig('name = "hut"\n' + CAMERA + 'line = "A"', "rig.toml", SENSORS)
    with pytest.raises(ConfigurationError, match="is wired to C1, which does not wait for it"):
        parse_rig('name = "hut"\n' + CAMERA + BOX, "rig.toml", SENSORS)
    assert parse_rig('name = "hut"\n' + CAMERA + 'line = "A"\n' + BOX, "rig.toml", SENSORS).cameras[0].wired


def test_what_the_documentation_shows_is_a_rig_file() -> None:
    text = (Path(__file__).parents[3] / "docs" / "instruments.md").read_text(encoding="utf-8")
    shown = [
        b for b in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if b.startswith(("[[cam", "[[proj"))
    ]
    drivers = set()
    for block in shown:
        wires = BOX if 'trigger = "Line' in block else ""
        lone = "" if "[[cameras]]" in block else "cameras = []\n"
        rig = parse_rig(f'name = "shown"\n{lone}{block}{wires}', "instruments.md", known_sensors())
        drivers |= {sensor.driver for sensor in (*rig.cameras, *rig.projectors)}
    assert drivers >= {"aravis", "opencv", "window"}
    (box,) = [b for b in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if b.startswith("[[triggers]]")]
    cameras = "".join(
        f'[[cameras]]\nname = "C{n}"\ndriver = "simulated"\ncolumns = 64\nrows = 64\n' for n in (1, 2)
    )
    (shown_box,) = parse_rig(
        f'name = "shown"\n{cameras}{box}', "instruments.md", known_sensors()
    ).serial.triggers
    assert [wire.sensor for wire in shown_box.wiring] == ["C1", "C2"]
