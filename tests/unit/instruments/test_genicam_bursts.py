"""GenICam cameras that a projector's pulses expose: features, stream, and the camera of Aravis."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import pytest
from support.gige_camera import ADDRESS, gige_camera

from sms_jobs.errors import DeviceFault, FrameLost, InvalidInput
from sms_jobs.formats.rig_configuration import SensorRecords, parse_rig
from sms_jobs.instruments.bursts import Players, Seen, played
from sms_jobs.instruments.cameras.aravis import DRIVER, AravisSettings, connect
from sms_jobs.instruments.clock import RealClock, SimulatedClock
from sms_jobs.instruments.genicam_cameras import Delivered, GenicamCamera, Value
from sms_jobs.instruments.optical_drivers import DriverContext
from sms_jobs.instruments.protocols import Frame
from sms_jobs.records.bursts import Burst, PulseTrain
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.optical_instruments import VirtualProjector

COLUMNS, ROWS = 160, 120
SETTINGS = AravisSettings(
    "C1", COLUMNS, ROWS, "aravis", 0.2, 1.5, ADDRESS, "Mono8", 10.0, pulse_line="Line2", readout_ms=5.0
)
BURST = Burst(4, 1.0, 0.02)


@dataclass
class Told:
    """A camera by its features and its stream: what it was told, and what it delivers."""

    clock: SimulatedClock = field(default_factory=SimulatedClock)
    features: dict[str, Value] = field(default_factory=dict)
    deliveries: list[Delivered] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    """How long each is under way."""
    started: list[int] = field(default_factory=list)
    running: bool = False

    def __post_init__(self) -> None:
        self.features |= {"TriggerMode": "Off", "TriggerSource": "Line7", "ExposureTime": 1.0}
        self.features |= {"PixelFormat": "", "Width": 1, "Height": 1}

    def has(self, name: str) -> bool:
        return name in self.features

    def get(self, name: str) -> Value:
        return self.features[name]

    def set(self, name: str, value: Value) -> None:
        if value == "Line9":
            raise DeviceFault("camera C1 refuses: it has no such line")
        self.features[name] = value

    def limits(self, name: str) -> tuple[float, float]:
        return 0.0, 1e9

    def execute(self, name: str) -> None:
        raise AssertionError(f"{name} in a burst")

    def start(self, buffers: int) -> None:
        self.started.append(buffers)
        self.running = True

    def stop(self) -> None:
        self.running = False

    def take(self, timeout_s: float, use: Callable[[Delivered], None]) -> bool:
        if not self.deliveries:
            self.clock.sleep(timeout_s)
            return False
        delivered = self.deliveries.pop(0)
        late_s = self.late_s.pop(0) if self.late_s else 0.0
        self.clock.sleep((delivered.time_s or 0.0) + late_s - self.clock.monotonic())
        use(delivered)
        return True

    def close(self) -> None:
        self.running = False


def delivered(number: int, time_s: float | None, problem: str = "") -> Delivered:
    return Delivered(number, time_s, np.full(COLUMNS * ROWS, number, np.uint8), problem)


def even(numbers: range) -> list[Delivered]:
    return [delivered(n, n * BURST.period_s) for n in numbers]


def camera(told: Told, **changes: str) -> GenicamCamera:
    return GenicamCamera(replace(SETTINGS, **changes), told, told, told.clock)  # type: ignore[arg-type]


@dataclass
class Playing:
    """A projector that a camera is tried with."""

    fire: Callable[[Burst], None] = lambda burst: None
    dark_times: int = 0

    def load(self, sequence: FringeSequence, dimming: object = None) -> None:
        raise AssertionError

    def show(self, number: int) -> None:
        raise AssertionError

    def white(self) -> None:
        raise AssertionError

    def play(self, burst: Burst) -> None:
        self.fire(burst)

    def wait(self) -> None:
        pass

    def dark(self) -> None:
        self.dark_times += 1


def through(one: GenicamCamera, projector: Playing | None = None, burst: Burst = BURST) -> list[Seen]:
    return played(Players(projector or Playing(), {"C1": one}), burst, 1.0, lambda number: None)


def test_a_camera_is_armed_once_for_all_frames() -> None:
    told = Told(deliveries=even(range(1, 5)))
    one = camera(told)
    assert told.features["TriggerSource"] == "Software"
    assert "triggered by software, by pulses on Line2" in one.describe()
    sources = []

    def fire(burst: Burst) -> None:
        sources.append((told.features["TriggerSource"], told.running))

    projector = Playing(fire)
    seen = through(one, projector)
    assert sources == [("Line2", True)]
    assert (told.running, projector.dark_times) == (False, 1)
    # A buffer for each frame and some for those that nobody expects, in one acquisition that goes on and on.
    (buffers,) = told.started
    assert buffers > BURST.frames
    assert [int(s["C1"].image[0, 0]) for s in seen] == [1, 2, 3, 4]
    assert [s["C1"].number for s in seen] == [1, 2, 3, 4]
    one.arm(1.0)
    assert told.features["TriggerSource"] == "Software"


def test_times_between_frames_are_the_cameras_own() -> None:
    # The first is under way longest: by its time alone the others would seem to be out of step.
    told = Told(deliveries=even(range(1, 5)), late_s=[0.008, 0.001, 0.004, 0.0])
    times = [s["C1"].time_s for s in through(camera(told))]
    np.testing.assert_allclose(np.diff(times), BURST.period_s, rtol=1e-9)
    assert times[0] == pytest.approx(BURST.period_s + 0.008)


@pytest.mark.parametrize(
    ("deliveries", "words"),
    [
        (even(range(1, 4)), r"C1 delivered 3 of 4 frames of a burst \(camera C1 delivered no frame within"),
        ([*even(range(1, 3)), *even(range(4, 6))], "went from frame 2 to 4 after frame 2 of a burst of 4"),
        (even(range(1, 6)), "C1 delivered 5 frames for 4 pulses"),
        (
            [*even(range(1, 3)), delivered(3, 0.06, "packets are missing"), delivered(4, 0.08)],
            r"C1 delivered 2 of 4 frames.*not complete: packets are missing",
        ),
        (
            [delivered(1, 0.02), delivered(2, 0.0403), delivered(3, 0.0603), delivered(4, 0.0803)],
            "not in step",
        ),
    ],
)
def test_what_is_not_whole_is_refused(deliveries: list[Delivered], words: str) -> None:
    told = Told(deliveries=deliveries)
    with pytest.raises(FrameLost, match=words):
        through(camera(told))
    assert (len(told.started), told.running) == (1, False)  # a burst is not begun anew in its middle


def test_a_hundredth_of_a_period_is_in_step() -> None:
    told = Told(deliveries=[delivered(1, 0.02), delivered(2, 0.0401), delivered(3, 0.06), delivered(4, 0.08)])
    assert len(through(camera(told))) == BURST.frames


def test_a_camera_without_times_is_refused() -> None:
    told = Told(deliveries=[delivered(n, None) for n in range(1, 5)])
    with pytest.raises(DeviceFault, match=r"C1 tells no times of its frames.*take it out of `pulses`"):
        through(camera(told))


def test_a_line_that_the_camera_does_not_have_is_told_when_it_is_connected() -> None:
    with pytest.raises(DeviceFault, match="TriggerSource was to be Line9; correct the rig file"):
        camera(Told(), pulse_line="Line9")


@pytest.mark.parametrize("wrong", [{"readout_ms": -1.0}, {"trigger": "acquisition"}])
def test_settings_that_cannot_be(wrong: dict[str, float | str]) -> None:
    with pytest.raises(InvalidInput, match="camera C1 has readout_ms"):
        replace(SETTINGS, **wrong)  # type: ignore[arg-type]


RIG = f"""
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
pulse_line = "Line2"
readout_ms = 5.0
[[projectors]]
name = "P1"
driver = "playing"
columns = 256
rows = 192
pulses = {{ cameras = ["C1"], period_ms = 12.0, lead_ms = 40.0 }}
"""


def test_a_rig_file_wires_pulses_to_lines() -> None:
    @dataclass(frozen=True)
    class PlayingProjector(VirtualProjector):
        driver: Literal["playing"]  # type: ignore[assignment]

    sensors = SensorRecords({"aravis": DRIVER.record}, {"playing": PlayingProjector})
    rig = parse_rig(RIG, "rig.toml", sensors)
    assert rig.projectors[0].pulse_train == PulseTrain(("C1",), 12.0, 40.0)
    assert rig.burst("P1", ("C1",), 48, 1.0) == Burst(48, 1.0, 0.015, 0.04, 0.01)
    assert rig.way("P1", ("C1",), (0.5, 1.0)) == "patterns played in a burst, one every 12, 15 ms"
    with pytest.raises(InvalidInput, match='name its line, such as pulse_line = "Line2"'):
        parse_rig(RIG.replace('pulse_line = "Line2"', ""), "rig.toml", sensors)


@pytest.fixture
def context() -> Iterator[DriverContext]:
    with gige_camera(), ExitStack() as ending:
        yield DriverContext(RealClock(), ending)


def pulsed(one: GenicamCamera) -> Frame:
    """Return a frame; the simulated camera forgets a pulse that comes before it has done with the last."""
    for _ in range(3):
        one._features.execute("TriggerSoftware")
        try:
            return one.read(2.0)
        except FrameLost:
            continue
    raise AssertionError("three pulses without a frame")


def test_a_camera_of_somebody_else_delivers_a_frame_for_each_pulse(context: DriverContext) -> None:
    """The software trigger serves as its line, and is pulsed through its features."""
    one = connect(replace(SETTINGS, pulse_line="Software"), context)
    images: list[int] = []
    burst = Burst(6, 1.0, 0.02)
    for _ in range(2):
        one.arm_burst(burst)
        numbers = []
        for _ in range(burst.frames):
            frame = pulsed(one)
            numbers.append(frame.number)
            images.append(int(frame.image[0, 0]))
        assert (np.diff(numbers) == 1).all()
        assert one.left_over(0.05) == 0
        with pytest.raises(FrameLost):
            one.read(0.05)
        one.disarm()
    # It simulates a ramp that goes on by one with each frame.
    assert (np.diff(images) % 255 == 1).all()
