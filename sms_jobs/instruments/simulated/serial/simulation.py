"""Simulators of all serial instruments of a rig, in memory or on pseudo-terminals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TypeVar

from sms_jobs.errors import NotFound
from sms_jobs.instruments.clock import Clock, RealClock
from sms_jobs.instruments.simulated.serial.axis import SimulatedAxis
from sms_jobs.instruments.simulated.serial.line import SimulatedDevice, SimulatedLine
from sms_jobs.instruments.simulated.serial.line_devices import SimulatedLineDevice, SimulatedScalar
from sms_jobs.instruments.simulated.serial.powercube import SimulatedPowerCubes
from sms_jobs.instruments.simulated.serial.ptu46 import SimulatedPtu46
from sms_jobs.instruments.simulated.serial.schunk_motion import SimulatedMotionModules
from sms_jobs.instruments.transports.memory import MemoryWire
from sms_jobs.instruments.transports.pseudo_terminal import PseudoTerminal
from sms_jobs.records.instruments import (
    Instruments,
    SerialChannel,
    Stage,
    TriggerController,
    VideoSplitter,
)
from sms_jobs.records.serial_links import LINK_FAULTS, Fault

Kind = TypeVar("Kind")
SerialInstrument = Stage | TriggerController | VideoSplitter | SerialChannel
NO_VALUES: Mapping[str, Callable[[float], float]] = MappingProxyType({})


class SerialSimulation:
    """Simulators of the serial instruments of a rig, all on one clock.

    Parameters
    ----------
    instruments
        With the faults that are to be committed.
    clock
        Of the rig.
    values
        By name of a channel: its value at a time of the clock, in its unit; 0 without.
    """

    def __init__(
        self,
        instruments: Instruments,
        clock: Clock,
        values: Mapping[str, Callable[[float], float]] = NO_VALUES,
    ) -> None:
        self._clock = clock
        self._axes: dict[str, dict[str, SimulatedAxis]] = {}
        self._devices: dict[str, SimulatedDevice] = {}
        self._lines: dict[str, SimulatedLine] = {}
        for instrument in instruments.serial:
            device = self._device(instrument, values)
            self._devices[instrument.name] = device
            self._lines[instrument.name] = SimulatedLine(device, instrument.link.baud_rate, instrument.faults)

    def line(self, name: str) -> SimulatedLine:
        """Return the wire to an instrument; raise `NotFound` where there is none."""
        return self._of(self._lines, name)

    def wire(self, name: str) -> MemoryWire:
        """Return a transport to an instrument, in memory."""
        return MemoryWire(self.line(name), self._clock)

    def angles(self, stage: str) -> tuple[float, float]:
        """Return where the axes of a stage really are now, in rad: what a camera would see."""
        axes, now = self._of(self._axes, stage), self._clock.monotonic()
        return axes["pan"].true_position(now), axes["tilt"].true_position(now)

    def controller(self, name: str) -> SimulatedLineDevice:
        """Return a controller or splitter, which remembers what it was commanded."""
        device = self._of(self._devices, name)
        if not isinstance(device, SimulatedLineDevice):
            raise NotFound(f"'{name}' is no simulated controller or splitter")
        return device

    def _of(self, known: Mapping[str, Kind], name: str) -> Kind:
        if name not in known:
            raise NotFound(f"there is no simulated '{name}': there is {', '.join(known) or 'none'}")
        return known[name]

    def _device(
        self, instrument: SerialInstrument, values: Mapping[str, Callable[[float], float]]
    ) -> SimulatedDevice:
        if isinstance(instrument, Stage):
            return self._stage(instrument)
        if isinstance(instrument, SerialChannel):
            return SimulatedScalar(instrument, values.get(instrument.name, lambda _now: 0.0))
        return SimulatedLineDevice(instrument)

    def _stage(self, stage: Stage) -> SimulatedDevice:
        axes = {"pan": _axis(stage, "pan"), "tilt": _axis(stage, "tilt")}
        self._axes[stage.name] = axes
        if stage.protocol == "ptu46":
            return SimulatedPtu46(axes)
        by_address = {stage.pan.module: axes["pan"], stage.tilt.module: axes["tilt"]}
        if stage.protocol == "schunk-motion":
            return SimulatedMotionModules(by_address, stage.unit_rad)
        return SimulatedPowerCubes(by_address, stage.checksum)


@dataclass(frozen=True)
class SimulatedPort:
    """A simulated instrument on a port.

    Attributes
    ----------
    device
        Its name in the rig.
    path
        What drivers and terminals open.
    baud_rate
        As in the rig file; a pseudo-terminal takes any.
    """

    device: str
    path: str
    baud_rate: int


class SimulatedPorts:
    """Simulators on pseudo-terminals, until they are closed; use it in a `with` statement.

    Attributes
    ----------
    ports
        Where they are.
    simulation
        What is behind them.
    """

    def __init__(self, instruments: Instruments, folder: Path | None, simulation: SerialSimulation) -> None:
        self.simulation = simulation
        self._open = ExitStack()
        ports = []
        for instrument in instruments.serial:
            terminal = self._open.enter_context(PseudoTerminal(simulation.line(instrument.name)))
            path = terminal.path
            if folder is not None:
                folder.mkdir(parents=True, exist_ok=True)
                link = folder / instrument.name
                link.unlink(missing_ok=True)
                link.symlink_to(path)
                self._open.callback(link.unlink, missing_ok=True)
                path = str(link)
            ports.append(SimulatedPort(instrument.name, path, instrument.link.baud_rate))
        self.ports = tuple(ports)

    def __enter__(self) -> SimulatedPorts:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all simulators and remove their links."""
        self._open.close()


def simulate(
    instruments: Instruments,
    folder: Path | None = None,
    values: Mapping[str, Callable[[float], float]] = NO_VALUES,
) -> SimulatedPorts:
    """Put the simulators of all serial instruments on pseudo-terminals.

    Parameters
    ----------
    instruments
        Of the rig; what their links say of ports does not matter.
    folder
        Where a link with each instrument's name is made, so that a rig file can name lasting ports.
    values
        Of channels, see `SerialSimulation`; their times are in s since the simulation began.
    """
    clock = RealClock()
    began = clock.monotonic()
    shifted = {name: _since(value, began) for name, value in values.items()}
    return SimulatedPorts(instruments, folder, SerialSimulation(instruments, clock, shifted))


def _since(value: Callable[[float], float], began: float) -> Callable[[float], float]:
    return lambda now: value(now - began)


def _axis(stage: Stage, name: str) -> SimulatedAxis:
    axis = stage.pan if name == "pan" else stage.tilt
    faults: list[Fault] = [f for f in stage.faults if f.axis == name and f.fault not in LINK_FAULTS]
    return SimulatedAxis(
        axis.minimum_rad, axis.maximum_rad, axis.velocity_rad_s, axis.acceleration_rad_s2, faults=faults
    )
