"""A rig file with simulated instruments: what it says happens, where and when it says so."""

from __future__ import annotations

import pytest

from sms_jobs.errors import DeviceFault
from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.instruments.clock import SimulatedClock
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.virtual_rig.campaigns import small_plate

RIG = """
name = "bench"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]

[[stages]]
name = "stage"
link = { port = "simulated", baud_rate = 38400 }
faults = [{ fault = "hunting-servo", state = "S08", amount = 0.002, times = 0 }]
"""


def test_a_fault_befalls_its_state_alone() -> None:
    scene = small_plate("plate")[1].scene
    assert scene is not None
    for state in ("S07", "S08", "S09"):
        with connected(parse_rig(RIG, "rig"), Setting(scene, state, ()), clock=SimulatedClock()) as rig:
            assert rig.stage is not None
            rig.stage.stage()
            moving = rig.stage.set(StagePose(0.1, -0.1))
            if state == "S08":
                with pytest.raises(DeviceFault, match="hunts: after 2 attempts"):
                    moving.wait()
            else:
                moving.wait()
