"""What a driver of cameras or projectors declares, so that a new one is one file and its test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Protocol, TypeVar

from sms_jobs.discovery import declared
from sms_jobs.errors import ConfigurationError
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.protocols import Camera, Projector
from sms_jobs.instruments.simulated.optics import VirtualRoom
from sms_jobs.records.optical_instruments import CameraInstrument, ProjectorInstrument

Shared = TypeVar("Shared")


class Described(Protocol):
    """A sensor that tells what it is."""

    def describe(self) -> str:
        """Return make, number, and how it is set, in a few words."""
        ...


class DescribedCamera(Camera, Described, Protocol):
    """A camera as a driver connects it."""


class DescribedProjector(Projector, Described, Protocol):
    """A projector as a driver connects it."""


@dataclass(frozen=True)
class DriverContext:
    """What a driver finds when it connects a sensor.

    Attributes
    ----------
    clock
        Of the rig.
    ending
        Takes what is to be done when the rig is let go: sensors are closed in it.
    room
        The room of a virtual rig, where the campaign describes one; real sensors do not ask for it.
    """

    clock: Clock
    ending: ExitStack
    room: VirtualRoom | None = None
    _shared: dict[object, Any] = field(default_factory=dict)

    def shared(self, key: object, make: Callable[[], Shared]) -> Shared:
        """Return what several sensors of a rig use together, made for the first of them."""
        if key not in self._shared:
            self._shared[key] = make()
        found: Shared = self._shared[key]
        return found


@dataclass(frozen=True)
class CameraDriver:
    """Declared as `DRIVER` by a module of `instruments.cameras`.

    Attributes
    ----------
    name
        As `driver` of a rig file.
    record
        What the file says of such a camera; its `driver` is the literal `name`.
    connect
        Connects a camera that such a record describes.
    """

    name: str
    record: type[CameraInstrument]
    connect: Callable[[Any, DriverContext], DescribedCamera]


@dataclass(frozen=True)
class ProjectorDriver:
    """Declared as `DRIVER` by a module of `instruments.projectors`; see `CameraDriver`."""

    name: str
    record: type[ProjectorInstrument]
    connect: Callable[[Any, DriverContext], DescribedProjector]


def camera_drivers() -> Mapping[str, CameraDriver]:
    """Return the drivers of cameras by name."""
    return declared("sms_jobs.instruments.cameras", "DRIVER")


def projector_drivers() -> Mapping[str, ProjectorDriver]:
    """Return the drivers of projectors by name."""
    return declared("sms_jobs.instruments.projectors", "DRIVER")


def optional_package(load: Callable[[], ModuleType], driver: str, extra: str) -> ModuleType:
    """Load what a driver needs and not every rig has.

    Raises
    ------
    ConfigurationError
        When it is not installed; the message names the extra of `sms_jobs` that brings it.
    """
    try:
        return load()
    except ImportError as error:
        raise ConfigurationError(
            f"the driver '{driver}' needs a package that is not installed ({error}): "
            f"`pip install 'sms-jobs[{extra}]'` brings it"
        ) from error
