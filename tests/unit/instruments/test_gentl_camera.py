"""Cameras of a GenTL producer, the one that comes with the standard's Python package, through harvesters."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sms_jobs.errors import ConfigurationError, DeviceFault, FrameLost, LinkLost
from sms_jobs.instruments.cameras.genicam import GentlSettings, connect
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.genicam_cameras import Delivered
from sms_jobs.instruments.optical_drivers import DriverContext

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="harvesters is installed for the tests on Linux alone"
)
COLUMNS, ROWS = 160, 120
TIMEOUT_S = 5.0


@pytest.fixture
def settings() -> GentlSettings:
    import genicam

    producer = Path(genicam.__file__).parent / "viky.cti"
    return GentlSettings(
        *("C1", COLUMNS, ROWS, "genicam", 0.2, 1.5, "VikyTL_DEV_red", "Mono8"),
        trigger="acquisition",
        producer=str(producer),
    )


@pytest.fixture
def context() -> Iterator[DriverContext]:
    with ExitStack() as ending:
        yield DriverContext(RealClock(), ending)


def test_every_trigger_is_one_frame(settings: GentlSettings, context: DriverContext) -> None:
    camera = connect(settings, context)
    camera.arm(1.0)
    for number in (1, 2, 3):
        begun = context.clock.monotonic()
        camera.trigger()
        frame = camera.read(TIMEOUT_S)
        assert frame.number == number
        assert begun < frame.time_s <= context.clock.monotonic()
        # A game of squash in black and white: both are there, and a ball is far smaller than the court.
        assert frame.image.shape == (ROWS, COLUMNS)
        assert set(np.unique(frame.image)) == {0, 255}
    with pytest.raises(FrameLost, match="C1 delivered no frame within"):
        camera.read(0.05)
    camera.disarm()


def test_frames_are_numbered_by_the_camera(settings: GentlSettings, context: DriverContext) -> None:
    stream = connect(settings, context)._stream
    for _ in range(2):  # each acquisition counts from 1
        got: list[Delivered] = []
        stream.start(4)
        for _ in range(3):
            assert stream.take(TIMEOUT_S, got.append)
        # At 20 frames a second none is ready at once.
        assert not stream.take(0.001, got.append)
        stream.stop()
        assert [delivered.number for delivered in got] == [1, 2, 3]


def test_two_cameras_of_one_producer(settings: GentlSettings, context: DriverContext) -> None:
    first, second = (
        connect(settings, context),
        connect(replace(settings, name="C2", device="1", rows=100), context),
    )
    for camera in (first, second):
        camera.arm(1.0)
        camera.trigger()
    assert first.read(TIMEOUT_S).image.shape == (ROWS, COLUMNS)
    assert second.read(TIMEOUT_S).image.shape == (100, COLUMNS)
    assert second.describe() == "1, 160 x 100 pixels Mono8, triggered by acquisition"


def test_features_are_set_before_all_else(settings: GentlSettings, context: DriverContext) -> None:
    camera = connect(replace(settings, features={"BouncingBallSize": 40, "ChunkModeActive": False}), context)
    told = camera._features
    assert told.get("BouncingBallSize") == 40
    assert told.get("ChunkModeActive") is False
    assert (told.get("Width"), told.get("Height"), told.get("PixelFormat")) == (COLUMNS, ROWS, "Mono8")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"pixel_format": "Mono12"}, "refuses.*'Mono12'.*PixelFormat was to be Mono12; correct the rig file"),
        ({"columns": 50}, "is to have Width = 50, and allows 100 to 800: correct the rig file"),
        ({"trigger": "software"}, 'cannot be triggered: say trigger = "acquisition"'),
        ({"exposure_ms": 5.0}, "has no feature ExposureTime or ExposureTimeAbs: remove it"),
        ({"features": {"EventNotification": 3}}, "wants no number for EventNotification"),
        ({"features": {"BouncingBallSize": "big"}}, "cannot convert string 'big' to int"),
        ({"features": {"BouncingBallSize": 20.5}}, "wants another kind of value for BouncingBallSize"),
        ({"features": {"Nonsense": 1}}, "has no feature Nonsense, which is to be 1"),
    ],
)
def test_what_a_camera_refuses_is_named(
    settings: GentlSettings, context: DriverContext, wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(DeviceFault, match=f"camera C1 .*{message}"):
        connect(replace(settings, **wrong), context)


def test_what_is_not_there(settings: GentlSettings, context: DriverContext) -> None:
    with pytest.raises(LinkLost, match=r"'9': the producer lists VikyTL_DEV_red \(serial number 0\), Viky"):
        connect(replace(settings, device="9"), context)
    with pytest.raises(LinkLost, match=r"the producer 'none\.cti', which is no file: install the camera's"):
        connect(replace(settings, producer="none.cti"), context)


def test_without_the_package_its_extra_is_named(
    settings: GentlSettings, context: DriverContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "harvesters.core", None)
    with pytest.raises(ConfigurationError, match=r"pip install 'sms-jobs\[genicam\]'"):
        connect(settings, context)
