"""A GigE Vision camera over UDP, as Aravis simulates it in another process, by the driver for real ones."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from math import log10
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.gige_camera import ADDRESS, gige_camera

from sms_jobs.errors import ConfigurationError, DeviceFault, FrameLost, InvalidInput, LinkLost
from sms_jobs.formats.rig_configuration import SIMULATED_SENSORS, parse_rig
from sms_jobs.instruments.cameras import aravis
from sms_jobs.instruments.cameras.aravis import DRIVER, AravisSettings, AravisStream, connect
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.connection import connected
from sms_jobs.instruments.genicam_cameras import GenicamCamera, steps_between
from sms_jobs.instruments.optical_drivers import DriverContext
from sms_jobs.instruments.protocols import Frame

COLUMNS, ROWS = 160, 120
SETTINGS = AravisSettings("C1", COLUMNS, ROWS, "aravis", 0.2, 1.5, ADDRESS, "Mono8", 10.0, gain=0.0)
TIMEOUT_S = 2.0


@pytest.fixture(scope="module")
def peer() -> Iterator[None]:
    with gige_camera():
        yield


@pytest.fixture
def context(peer: None) -> Iterator[DriverContext]:
    with ExitStack() as ending:
        yield DriverContext(RealClock(), ending)


def taken(camera: GenicamCamera) -> Frame:
    """Return a frame; the simulated camera forgets a trigger that comes before it has done with the last."""
    for _ in range(3):
        camera.trigger()
        try:
            return camera.read(TIMEOUT_S)
        except FrameLost:
            continue
    raise AssertionError("three triggers without a frame")


def seen(camera: GenicamCamera) -> NDArray[Any]:
    return taken(camera).image


def queued(camera: GenicamCamera) -> bool:
    """Whether a frame has come that was not taken."""
    stream = camera._stream
    assert isinstance(stream, AravisStream)
    waiting, filled = ctypes.c_int(), ctypes.c_int()
    arguments = (ctypes.c_void_p(stream._stream), ctypes.byref(waiting), ctypes.byref(filled))
    aravis.library().arv_stream_get_n_buffers(*arguments)
    return filled.value > 0


def ramp(first: int, exposure_ms: float) -> NDArray[np.uint8]:
    """What the camera simulates: a diagonal ramp that goes on with each frame, scaled by the exposure."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    return np.minimum((x + y + first) % 255 * (1.0 + log10(exposure_ms / 10.0)), 255.0).astype(np.uint8)


def test_every_trigger_is_one_frame(context: DriverContext) -> None:
    camera = connect(SETTINGS, context)
    camera.arm(1.0)
    first = int(seen(camera)[0, 0])
    for step in range(1, 4):
        image = seen(camera)
        np.testing.assert_array_equal(image, ramp((first + step) % 255, 10.0))
    with pytest.raises(FrameLost, match=r"C1 delivered no frame within 0\.2 s of its trigger"):
        camera.read(0.2)
    camera.disarm()
    assert (camera.facts.dtype, camera.facts.full_scale) == ("uint8", 255)


def test_exposures_are_multiples_of_the_cameras_own(context: DriverContext) -> None:
    camera = connect(SETTINGS, context)
    numbers, before = [], None
    for exposure in (1.0, 2.0, 0.5):
        camera.arm(exposure)
        frame = taken(camera)
        numbers.append(frame.number)
        if before is not None:  # the ramp goes on by one, so that all of the image is known
            before = (before + 1) % 255
            np.testing.assert_array_equal(frame.image, ramp(before, 10.0 * exposure))
        else:
            before = int(frame.image[0, 0])
    assert numbers == [1, 2, 3]
    with pytest.raises(DeviceFault, match=r"ExposureTimeAbs = 2e\+07, and allows 10 to 1e\+07"):
        camera.arm(2000.0)


def test_without_an_exposure_the_cameras_own_is_kept(context: DriverContext) -> None:
    camera = connect(replace(SETTINGS, exposure_ms=0.0), context)
    camera.arm(1.0)
    seen(camera)
    with pytest.raises(DeviceFault, match="its rig file has no exposure"):
        camera.arm(2.0)


def test_times_are_those_of_the_rig(context: DriverContext) -> None:
    camera = connect(SETTINGS, context)
    camera.arm(1.0)
    for _ in range(4):
        begun = context.clock.monotonic()
        frame = taken(camera)
        # The first frame sets the camera's clock, at most by what it took to come too late.
        assert begun - 1.0 < frame.time_s <= context.clock.monotonic()


def test_sixteen_bits(context: DriverContext) -> None:
    camera = connect(replace(SETTINGS, pixel_format="Mono16"), context)
    camera.arm(1.0)
    image = seen(camera)
    assert (camera.facts.dtype, camera.facts.full_scale) == ("uint16", 65535)
    # The ramp again, 256 times as steep.
    assert set(np.unique(np.diff(image.astype(np.int64), axis=1))) <= {255, 256, 257} | set(range(-65536, 0))
    assert image.max() > 255


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"pixel_format": "Mono12"}, "refuses.*'Mono12'.*PixelFormat was to be Mono12; correct the rig file"),
        ({"columns": 5000}, "is to have Width = 5000, and allows 1 to 2048: correct the rig file"),
        ({"trigger": "Line9"}, "TriggerSource was to be Line9"),
        ({"gain": 1.5}, "wants a whole number or a truth value for GainRaw"),
        ({"features": {"TriggerActivation": 3}}, "wants no number for TriggerActivation"),
        ({"features": {"TestRegister": "seven"}}, "wants a whole number or a truth value for TestRegister"),
        ({"features": {"BinningVertical": 1.5}}, "wants a whole number or a truth value for BinningVertical"),
        ({"features": {"AcquisitionFrameRate": "fast"}}, "wants a number for AcquisitionFrameRate"),
        ({"features": {"Nonsense": 1}}, "has no feature Nonsense, which is to be 1"),
        ({"features": {"BinningVertical": 99}}, "BinningVertical = 99, and allows 1 to 16"),
    ],
)
def test_what_a_camera_refuses_is_named(context: DriverContext, wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(DeviceFault, match=f"camera C1 .*{message}"):
        connect(replace(SETTINGS, **wrong), context)


def test_other_features_region_and_gain(context: DriverContext) -> None:
    features = {"TestRegister": 7, "AcquisitionFrameRate": 12.5, "TriggerActivation": "RisingEdge"}
    camera = connect(
        replace(SETTINGS, features=features, offset_x=8, offset_y=4, gain=1.0, columns=80, rows=60), context
    )
    camera.arm(1.0)
    image = seen(camera)
    assert image.shape == (60, 80)
    told = camera._features
    values = {"OffsetX": 8, "OffsetY": 4, "Width": 80, "GainRaw": 1, "TestRegister": 7, "TriggerMode": "On"}
    assert {name: told.get(name) for name in values} == values


def test_frames_that_nobody_asked_for_are_not_taken_for_others(
    context: DriverContext, caplog: pytest.LogCaptureFixture
) -> None:
    camera = connect(SETTINGS, context)
    camera.arm(1.0)
    first = taken(camera)
    while not queued(camera):
        camera._features.execute("TriggerSoftware")  # as noise on a line would
        deadline = context.clock.monotonic() + TIMEOUT_S
        while not queued(camera) and context.clock.monotonic() < deadline:
            pass
    second = taken(camera)
    # By the gap the recorder knows, and shows the pattern again.
    assert second.number == first.number + 2
    np.testing.assert_array_equal(second.image, ramp((int(first.image[0, 0]) + 2) % 255, 10.0))
    assert "C1 delivered 1 frames without being triggered" in caplog.text


def test_a_camera_that_cannot_be_triggered_begins_anew(context: DriverContext) -> None:
    camera = connect(replace(SETTINGS, trigger="acquisition"), context)
    camera.arm(1.0)
    with pytest.raises(FrameLost):
        camera.read(0.05)
    for number in (1, 2, 3):
        assert taken(camera).number == number


def test_a_camera_that_is_not_there(context: DriverContext) -> None:
    with pytest.raises(LinkLost, match=r"camera C1 does not answer.*whether `arv-tool-0.8` lists 'Nobody-1'"):
        connect(replace(SETTINGS, device="Nobody-1"), context)


def test_without_the_library_its_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis, "_LIBRARIES", ("libaravis-0.0.so",))
    aravis.library.cache_clear()
    try:
        with (
            ExitStack() as ending,
            pytest.raises(ConfigurationError, match="apt-get install aravis-tools-cli"),
        ):
            connect(SETTINGS, DriverContext(RealClock(), ending))
    finally:
        aravis.library.cache_clear()


def test_a_wired_camera_waits_for_its_line(peer: None) -> None:
    text = f"""
name = "hall"
[[cameras]]
name = "C1"
driver = "aravis"
device = "{ADDRESS}"
columns = {COLUMNS}
rows = {ROWS}
pixel_format = "Mono8"
exposure_ms = 10.0
noise_gain = 0.2
read_noise = 1.5
trigger = "Line0"
features = {{ GainAuto = "Off" }}
[[triggers]]
name = "box"
link = {{ port = "simulated" }}
protocol = {{ accepted = "OK" }}
trigger = "T{{output}}"
wiring = [{{ sensor = "C1", output = 1 }}]
"""
    rig = parse_rig(text, "rig.toml", replace(SIMULATED_SENSORS, cameras={"aravis": DRIVER.record}))
    with connected(rig) as found:
        assert found.described["C1"] == (
            "Aravis Fake 0.8.26, 127.0.0.1, 160 x 120 pixels Mono8, exposed for 10 ms, triggered by Line0"
        ).replace("0.8.26", found.described["C1"].split()[2].rstrip(","))
        found.cameras["C1"].arm(1.0)
        found.trigger.fire(found.cameras)
        # Nothing hangs on the wire; a trigger by software would have been answered.
        with pytest.raises(FrameLost, match="C1 delivered no frame"):
            found.cameras["C1"].read(0.2)


def test_numbers_of_sixteen_bits_begin_again_with_one() -> None:
    assert [steps_between(a, b) for a, b in ((1, 2), (65534, 65535), (65535, 1), (65533, 2))] == [1, 1, 1, 4]
    assert steps_between(2**40, 2**40 + 3) == 3


@pytest.mark.parametrize("wrong", [{"exposure_ms": -1.0}, {"device": ""}, {"trigger": ""}, {"offset_x": -1}])
def test_settings_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="camera C1"):
        replace(SETTINGS, **wrong)
