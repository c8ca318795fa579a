"""Rigs: the instruments that are connected to this host, and who holds them.

What talks to instruments is imported by the functions that do.
"""

from __future__ import annotations

import getpass
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.devices import locks
from sms_jobs.jobs.devices.locks import HeldDevice
from sms_jobs.kinds.kind import rig_queue
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.instruments.checking import RigCheck
    from sms_jobs.instruments.scanners.server import ScannerServer
    from sms_jobs.instruments.simulated.serial.simulation import SimulatedPorts
    from sms_jobs.records.optical_instruments import RigFile

_LONGEST = timedelta(minutes=5)
"""What a check or a move may take; a rig whose holder was killed is free again after it."""


def example() -> str:
    """Return a commented rig file."""
    from sms_jobs.formats.rig_configuration import example_rig

    return example_rig()


@use_case(Right.RECORD)
def add(services: Services, file: Path, *, replace: bool = False) -> RigFile:
    """Connect the rig that a file describes to this host.

    Raises
    ------
    InvalidInput
        The file cannot be read.
    Conflict
        There is a rig of that name, which is not to be replaced.
    """
    return services.stations.add(file, replace)


@use_case(Right.READ)
def list_rigs(services: Services) -> list[RigFile]:
    """Return the rigs that are connected to this host."""
    return [services.stations.rig(name) for name in services.stations.names()]


@use_case(Right.READ)
def file_text(services: Services, rig: str) -> str:
    """Return the file of a rig; raises `NotFound` where it is not connected to this host."""
    services.stations.rig(rig)
    return (services.settings.rig_folder / f"{rig}.toml").read_text("utf-8")


@dataclass(frozen=True)
class RigReport:
    """What the instruments of a rig say, and the unit of each channel."""

    rig: RigFile
    check: RigCheck
    units: Mapping[str, str]


@use_case(Right.RECORD)
def check(services: Services, rig: str) -> RigReport:
    """Talk to every instrument of a rig, and light every projector in turn.

    Raises
    ------
    NotFound
        It is not connected to this host.
    Conflict
        Somebody else holds it.
    InstrumentError
        An instrument does not answer.
    """
    from sms_jobs.instruments.checking import checked
    from sms_jobs.instruments.connection import connected

    with _held(services, rig, "check") as described, connected(described) as found:
        check = checked(found)
        return RigReport(described, check, {name: channel.unit for name, channel in found.channels.items()})


@use_case(Right.RECORD)
def home_stage(services: Services, rig: str) -> None:
    """Bring a rig's stage home, the way it came; raises as `check` does."""
    from sms_jobs.instruments.connection import connected_stage

    with _held(services, rig, "home") as described, connected_stage(described) as stage:
        stage.home()


@use_case(Right.RECORD)
def move_stage(services: Services, rig: str, pan_rad: float, tilt_rad: float) -> tuple[float, float]:
    """Bring a rig's stage to a pose, and return where it stands then; raises as `check` does."""
    from sms_jobs.instruments.connection import connected_stage

    with _held(services, rig, "move") as described, connected_stage(described) as stage:
        stage.stage()
        stage.move(pan_rad, tilt_rad)
        return stage.angles()


@use_case(Right.RECORD)
def stop(services: Services, rig: str) -> list[str]:
    """Stop a rig's stages at once, whoever uses them, and return which."""
    from sms_jobs.instruments.clock import RealClock
    from sms_jobs.instruments.devices.emergency_stop import emergency_stop

    return list(emergency_stop(services.stations.rig(rig).serial.stages, RealClock()))


@use_case(Right.RECORD)
def simulation(services: Services, rig: str, folder: Path | None) -> SimulatedPorts:
    """Put simulators of a rig's serial instruments on pseudo-terminals, with links to them in a folder."""
    from sms_jobs.instruments.simulated.serial.simulation import simulate

    return simulate(services.stations.rig(rig).serial, folder)


@dataclass(frozen=True)
class LentScanner:
    """A scanner that clients can have, and the file of what they have to know."""

    server: ScannerServer
    key_file: Path


@use_case(Right.RECORD)
def lend(services: Services, rig: str, listen: str, key_file: Path | None = None) -> LentScanner:
    """Lend the cameras and projectors of a scanner to a client at a time, once its server serves.

    Parameters
    ----------
    listen
        Address and port for clients.
    key_file
        Made if it is missing; beside the rig's file if it is None.

    Raises
    ------
    InvalidInput
        The address cannot be used.
    NotFound
        The rig is not connected to this host.
    """
    from sms_jobs.instruments.scanners.keys import made_key
    from sms_jobs.instruments.scanners.link import Address
    from sms_jobs.instruments.scanners.server import ScannerServer

    address = Address.parse(listen)
    stations, settings = services.stations, services.settings
    stations.rig(rig)
    path = key_file or settings.rig_folder / f"{rig}.key"
    key = made_key(path)
    return LentScanner(ScannerServer(lambda: stations.rig(rig), address, key, settings.threads), path)


@contextmanager
def _held(services: Services, rig: str, doing: str) -> Iterator[RigFile]:
    """Hold a rig as a recording does, so that none begins meanwhile and none is disturbed."""
    holder = f"{getpass.getuser()}, sms rig {doing}, process {os.getpid()} on {socket.gethostname()}"
    described = services.stations.rig(rig)
    with services.catalogue.writing() as session:
        locks.acquire_for(session, [rig_queue(rig)], holder, datetime.now(UTC), _LONGEST)
    try:
        yield described
    finally:
        with services.catalogue.writing() as session:
            locks.release(session, holder=holder)


@use_case(Right.READ)
def held_devices(services: Services) -> list[HeldDevice]:
    """Return which devices are held, by whom and since when."""
    with services.catalogue.reading() as session:
        return locks.held_devices(session, datetime.now(UTC))


@use_case(Right.RECORD)
def release(services: Services, device: str) -> HeldDevice:
    """Forget a lock whose holder is gone, and return it.

    Raises
    ------
    NotFound
        Nobody holds the device.
    Conflict
        Its holder is alive.
    """
    with services.catalogue.writing() as session:
        return locks.release_device(session, device, datetime.now(UTC))
