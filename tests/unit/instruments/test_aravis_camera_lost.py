"""A GigE Vision camera whose frames get lost on the way, and one that is gone."""

from __future__ import annotations

from contextlib import ExitStack

import pytest
from support.gige_camera import ADDRESS, gige_camera

from sms_jobs.errors import FrameLost, LinkLost
from sms_jobs.instruments.cameras.aravis import AravisSettings, connect
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.optical_drivers import DriverContext

SETTINGS = AravisSettings("C1", 160, 120, "aravis", 0.2, 1.5, ADDRESS, "Mono8", exposure_ms=10.0)
TIMEOUT_S = 5.0


def test_a_frame_that_lost_packets_is_lost() -> None:
    # A frame has twelve packets: all of them arrive once in 60 000 times.
    with gige_camera(lost_packets=0.6), ExitStack() as ending:
        camera = connect(SETTINGS, DriverContext(RealClock(), ending))
        camera.arm(1.0)
        camera.trigger()
        with pytest.raises(FrameLost, match=r"camera C1 delivered (no frame|a frame that is not complete: )"):
            camera.read(TIMEOUT_S)


@pytest.mark.long
def test_a_cable_that_was_pulled() -> None:
    with gige_camera() as process, ExitStack() as ending:
        camera = connect(SETTINGS, DriverContext(RealClock(), ending))
        camera.arm(1.0)
        camera.trigger()
        camera.read(TIMEOUT_S)
        process.kill()
        process.wait()
        with pytest.raises(LinkLost, match=r"camera C1 does not answer: .*; check its cable and power"):
            camera.trigger()
