"""From a rig file to connected instruments, and back to instruments that stand still in the dark."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from types import TracebackType

from sms_jobs.errors import InstrumentError, NotFound
from sms_jobs.instruments.cameras.scanner import ScannerCamera
from sms_jobs.instruments.clock import Clock, RealClock
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.devices.connecting import Connector
from sms_jobs.instruments.devices.device import Device
from sms_jobs.instruments.devices.pan_tilt import PanTilt
from sms_jobs.instruments.devices.scalar_channels import ChannelValue
from sms_jobs.instruments.devices.trigger_controller import TriggerBox, VideoSwitch
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.instruments.optical_drivers import (
    DescribedCamera,
    DescribedProjector,
    DriverContext,
    camera_drivers,
    projector_drivers,
)
from sms_jobs.instruments.protocols import Camera, Fired, Lamp, SoftwareTrigger, StandingLamp
from sms_jobs.instruments.scanners.client import links
from sms_jobs.instruments.simulated.lamp import RoomLamp
from sms_jobs.instruments.simulated.optics import Setting, SimulatedCamera, VirtualRoom
from sms_jobs.instruments.simulated.serial.simulation import SerialSimulation
from sms_jobs.records.instruments import TriggerController, VideoSplitter
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.records.serial_links import SIMULATED
from sms_jobs.records.units import in_unit_of_name


@contextmanager
def connected(
    rig: RigFile, setting: Setting | None = None, threads: int = 1, clock: Clock | None = None
) -> Iterator[ConnectedRig]:
    """Connect the instruments of a rig; at the end they stand still and are let go.

    Parameters
    ----------
    rig
        What its file says.
    setting
        What stands before simulated cameras; None where nothing is simulated, or nothing is looked at.
    threads
        For rendering.
    clock
        Of the rig; that of this computer if not given.

    Raises
    ------
    InstrumentError
        When an instrument does not answer, or does not work.
    """
    clock = clock or RealClock()
    faulty = rig.serial.at("" if setting is None else setting.state)
    simulation = SerialSimulation(faulty, clock, _values(setting, rig))
    connector = Connector(clock, OperationLog(clock), simulation)
    with ExitStack() as stack:

        def open_(device: Device) -> None:
            stack.callback(device.close)
            device.connect()

        stage = None if rig.stage is None else connector.stage(rig.stage)
        angles = None
        if stage is not None and rig.stage is not None:
            open_(stage)
            stack.push(partial(_stand_still, stage))
            if rig.stage.link.port == SIMULATED:
                angles = partial(simulation.angles, rig.stage.name)
        boxes = [connector.trigger_controller(t) for t in rig.serial.triggers]
        switches = [connector.video_splitter(s) for s in rig.serial.splitters]
        channels = [connector.channel(c) for c in rig.serial.channels]
        for device in (*boxes, *switches, *channels):
            open_(device)
        room = None if setting is None else VirtualRoom(setting, clock, angles, threads)
        context = DriverContext(clock, stack, room)
        cameras, projectors = _sensors_of(rig, context)
        lamp: Lamp = StandingLamp() if room is None else RoomLamp(room, links(context))
        yield ConnectedRig(
            rig.name,
            cameras,
            projectors,
            clock,
            WiredTrigger(clock, tuple(zip(boxes, map(_sensors, rig.serial.triggers), strict=True))),
            {c.name: ChannelValue(c) for c in channels},
            stage,
            WiredVideo(tuple(zip(switches, map(_sensors, rig.serial.splitters), strict=True))),
            room.simulation if room is not None and (rig.simulated or _simulated_there(cameras)) else None,
            {name: sensor.describe() for name, sensor in (*cameras.items(), *projectors.items())},
            lamp,
            rig.burst,
        )


@contextmanager
def channel_reader(rig: RigFile, name: str, clock: Clock | None = None) -> Iterator[Callable[[], float]]:
    """Connect one channel of a rig, and give what reads it.

    Raises
    ------
    NotFound
        When the rig has no such channel.
    LinkLost
        When it does not answer.
    """
    settings = next((c for c in rig.serial.channels if c.name == name), None)
    if settings is None:
        known = ", ".join(c.name for c in rig.serial.channels) or "none"
        raise NotFound(f"rig {rig.name} has no channel '{name}'; it has {known}")
    clock = clock or RealClock()
    simulation = SerialSimulation(rig.serial.at(""), clock)
    channel = Connector(clock, OperationLog(clock), simulation).channel(settings)
    try:
        channel.connect()
        yield ChannelValue(channel).read
    finally:
        channel.close()


@contextmanager
def connected_stage(rig: RigFile, clock: Clock | None = None) -> Iterator[PanTilt]:
    """Connect the stage of a rig, and nothing else of it: a stage moves without cameras and displays.

    Raises
    ------
    NotFound
        When the rig has no stage.
    InstrumentError
        When it does not answer, or does not work.
    """
    if rig.stage is None:
        raise NotFound(f"rig {rig.name} has no stage; describe one under [[stages]] of its file")
    clock = clock or RealClock()
    simulation = SerialSimulation(rig.serial.at(""), clock)
    stage = Connector(clock, OperationLog(clock), simulation).stage(rig.stage)
    with ExitStack() as stack:
        stack.callback(stage.close)
        stage.connect()
        stack.push(partial(_stand_still, stage))
        yield stage


def _stand_still(
    stage: PanTilt,
    problem: type[BaseException] | None,
    error: BaseException | None,
    trace: TracebackType | None,
) -> None:
    """Stop a stage that may be on its way when the recording breaks off."""
    if problem is not None:
        with suppress(InstrumentError):
            stage.stop()


def _sensors_of(
    rig: RigFile, context: DriverContext
) -> tuple[dict[str, DescribedCamera], dict[str, DescribedProjector]]:
    """Connect cameras and projectors by name; simulated ones are there only where there is a room."""
    if rig.simulated and context.room is None:
        return {}, {}
    makes, lights = camera_drivers(), projector_drivers()
    return (
        {c.name: makes[c.driver].connect(c, context) for c in rig.cameras},
        {p.name: lights[p.driver].connect(p, context) for p in rig.projectors},
    )


def _simulated_there(cameras: Mapping[str, Camera]) -> bool:
    """Say whether all cameras are those of scanners that look at a virtual rig."""
    return bool(cameras) and all(isinstance(c, ScannerCamera) and c.simulated for c in cameras.values())


@dataclass(frozen=True)
class WiredTrigger:
    """Exposes cameras through the controllers that they are wired to, the others over their own links.

    Attributes
    ----------
    clock
        Of the rig.
    boxes
        The controllers, each with the names of the cameras on its outputs.
    """

    clock: Clock
    boxes: tuple[tuple[TriggerBox, frozenset[str]], ...]

    def fire(self, cameras: Mapping[str, Camera]) -> dict[str, Fired]:
        """Expose all of them, and return by name when that was."""
        wired = {name for _, names in self.boxes for name in names if name in cameras}
        # The light of a simulated trigger line reaches a simulated camera by a call; a real one is told
        # beforehand, so that it does not take for an answer what it exposed before.
        simulated = {name for name in wired if isinstance(cameras[name], SimulatedCamera)}
        for name in wired - simulated:
            cameras[name].trigger()
        fired: dict[str, Fired] = {}
        for box, sensors in self.boxes:
            if names := [name for name in cameras if name in sensors]:
                fired |= box.fire(names)
        by_link = {n: camera for n, camera in cameras.items() if n in simulated or n not in wired}
        return SoftwareTrigger(self.clock).fire(by_link) | fired


@dataclass(frozen=True)
class WiredVideo:
    """Feeds the picture to the projector that is to show it.

    Attributes
    ----------
    switches
        The splitters, each with the names of the projectors on its outputs.
    """

    switches: tuple[tuple[VideoSwitch, frozenset[str]], ...]

    def feed(self, projector: str) -> None:
        """Feed a projector; it has the picture when this returns."""
        for switch, wired in self.switches:
            if projector in wired:
                switch.set(projector).wait()


def _sensors(box: TriggerController | VideoSplitter) -> frozenset[str]:
    return frozenset(wire.sensor for wire in box.wiring)


def _values(setting: Setting | None, rig: RigFile) -> dict[str, Callable[[float], float]]:
    """Return what simulated channels read, in their units: what the state says in those of their names."""
    said = {} if setting is None else setting.channels
    units = {channel.name: channel.unit for channel in rig.serial.channels if channel.name in said}
    return {
        name: partial(_steady, said[name] / in_unit_of_name(name, 1.0, unit)) for name, unit in units.items()
    }


def _steady(value: float, time_s: float) -> float:
    return value
