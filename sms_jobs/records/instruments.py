"""How the serial instruments of a rig are connected: what a rig file says of them, ready for their drivers.

Shape::

    Instruments(stages, triggers, splitters, channels)      all that have a wire or a file of their own
      Stage(name, link, protocol, pan, tilt, ...)           pan-tilt: PowerCube, SCHUNK Motion, PTU-46
      TriggerController(name, link, protocol, wiring, ...)  which output triggers whom, by which words
      VideoSplitter(name, link, protocol, wiring, select)   which projector is fed by which output
      SerialChannel(name, link, protocol, reply, unit, ...) a load cell, or whatever speaks ASCII
      FileChannel(name, path, column, unit, ...)            a CSV file that load-frame software appends to

Each has a `name` that is unique in the rig, and `faults` (`serial_links.Fault`) that its simulator is to
commit; real devices ignore them. `link` is a `serial_links.SerialLink`, whose `port` is a device file, or
`simulated` for a simulator in memory. The text protocol of controllers, splitters and channels is a
`serial_links.LineProtocol`, their outputs are `serial_links.Wire`s. Angles are in rad, times in s.
`operations.Reading` and `operations.Operation` are what instruments give back.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from math import isfinite, pi, radians
from typing import Literal

from sms_jobs.errors import InvalidInput
from sms_jobs.records.serial_links import (
    LINK_FAULTS,
    SIMULATED,
    Fault,
    LineProtocol,
    SerialLink,
    Wire,
    check_pattern,
)
from sms_jobs.records.subject import checked_name

REQUEST = re.compile(r"(?:[^{}]|\{output(?::0?[0-9]?[dxX])?\})*")
"""What may be replaced in a request; the file of a rig is not trusted with Python's whole format language."""


@dataclass(frozen=True)
class Axis:
    """One axis of a stage.

    Attributes
    ----------
    module
        Its address on the link: 1 to 31 for PowerCubes, 1 to 255 for the SCHUNK Motion Protocol; a PTU-46
        has none and ignores it.
    minimum_rad, maximum_rad
        Where it may go.
    velocity_rad_s, acceleration_rad_s2
        Of the steady part and of both ramps of a move: gentle enough that the spheres do not shake.
    """

    module: int
    minimum_rad: float
    maximum_rad: float
    velocity_rad_s: float = radians(20.0)
    acceleration_rad_s2: float = radians(20.0)

    def __post_init__(self) -> None:
        if not 1 <= self.module <= 255:
            raise InvalidInput(f"a module has an address from 1 to 255, not {self.module}")
        if not self.minimum_rad <= 0.0 <= self.maximum_rad or self.minimum_rad == self.maximum_rad:
            raise InvalidInput(
                f"the range {self.minimum_rad:.4g} .. {self.maximum_rad:.4g} rad of module {self.module} "
                "does not contain its home position 0: give a minimum below and a maximum above it"
            )
        if self.maximum_rad - self.minimum_rad > 2.0 * pi * (1.0 + 1e-12):
            raise InvalidInput(
                f"the range of module {self.module} is {self.maximum_rad - self.minimum_rad:.4g} rad, more "
                "than one turn: restrict it to 2 pi, so that the cable does not coil"
            )
        if self.velocity_rad_s <= 0.0 or self.acceleration_rad_s2 <= 0.0:
            raise InvalidInput(
                f"module {self.module} has a velocity of {self.velocity_rad_s} rad/s and an acceleration of "
                f"{self.acceleration_rad_s2} rad/s^2: both must be positive"
            )


PW070_PAN = Axis(module=12, minimum_rad=radians(-120.0), maximum_rad=radians(120.0))
"""Thesis Table 1, with a velocity far below the 248 degrees/s that the axis can do."""
PW070_TILT = Axis(module=13, minimum_rad=radians(-108.0), maximum_rad=radians(108.0))


@dataclass(frozen=True)
class Settling:
    """When an axis counts as standing still: servos drift about their position for a while after a move.

    Attributes
    ----------
    tolerance_rad
        Largest distance from the position that was asked for.
    for_s
        How long it must stay within.
    timeout_s
        After which a servo that does not settle is reported as hunting.
    attempts
        How often the position is commanded in all before that.
    """

    tolerance_rad: float = radians(0.01)
    for_s: float = 0.3
    timeout_s: float = 10.0
    attempts: int = 2

    def __post_init__(self) -> None:
        if self.tolerance_rad <= 0.0 or not 0.0 <= self.for_s < self.timeout_s or self.attempts < 1:
            raise InvalidInput(
                f"settling within {self.tolerance_rad} rad for {self.for_s} s, at most {self.timeout_s} s, "
                f"{self.attempts} attempts cannot be: tolerance and attempts must be positive, and the time "
                "limit longer than the time to stay within"
            )


@dataclass(frozen=True)
class TripodClearance:
    """The geometry that limits the tilt: a ball bar above a tripod (thesis 3.2.3, Figure 18).

    The tripod is taken as a solid cone about the pan axis that holds all legs, cut off at its top; so a tilt
    that is allowed is allowed at every pan.

    Attributes
    ----------
    bar_length_mm, sphere_radius_mm
        Distance of the spheres' centres, and their radius.
    stalk_mm, slide_mm
        As of `BallBar`: from the axes to the bar, and from the clamp to the bar's middle.
    top_below_axes_mm
        How far the tripod's top lies below the point where the axes meet.
    top_radius_mm
        Of the tripod's top.
    leg_angle_rad
        Between a leg and the pan axis.
    clearance_mm
        Distance to keep.
    """

    bar_length_mm: float
    sphere_radius_mm: float
    stalk_mm: float
    slide_mm: float
    top_below_axes_mm: float
    top_radius_mm: float
    leg_angle_rad: float
    clearance_mm: float = 10.0

    def __post_init__(self) -> None:
        if min(self.bar_length_mm, self.sphere_radius_mm, self.top_below_axes_mm) <= 0.0:
            raise InvalidInput(
                "bar length, sphere radius and the depth of the tripod's top below the axes must be positive"
            )
        if not 0.0 <= self.leg_angle_rad < pi / 2.0 or self.top_radius_mm < 0.0 or self.clearance_mm < 0.0:
            raise InvalidInput(
                f"a tripod with legs at {self.leg_angle_rad:.3g} rad, top of {self.top_radius_mm} mm radius "
                f"and {self.clearance_mm} mm clearance cannot be: legs stand at 0 to pi/2 rad, the rest is 0 "
                "or more"
            )


@dataclass(frozen=True)
class Stage:
    """A pan-tilt stage.

    Attributes
    ----------
    protocol
        `powercube` (SCHUNK/Amtec PowerCube, M5 dialect), `schunk-motion` (newer modules) or `ptu46`.
    pan, tilt
        Its axes.
    start
        Of both axes: one after the other, together by one command each, or together by a common start
        signal, which only PowerCubes know.
    checksum
        Of PowerCubes: the maker's, or that of the CARMEN family. Both are understood in replies.
    unit_rad
        Of the SCHUNK Motion Protocol: what the modules are configured to count in; a degree by default.
    backlash_rad
        How far an axis goes beyond a position that it approaches from above, to come back to it from below;
        0 for gears without play.
    settling
        When a move is over.
    clearance
        What limits the tilt beside the axis itself; None for a stage that carries nothing long.
    """

    name: str
    link: SerialLink
    protocol: Literal["powercube", "schunk-motion", "ptu46"] = "powercube"
    pan: Axis = PW070_PAN
    tilt: Axis = PW070_TILT
    start: Literal["one-after-the-other", "together", "on-signal"] = "together"
    checksum: Literal["maker", "carmen"] = "maker"
    unit_rad: float = pi / 180.0
    backlash_rad: float = 0.0
    settling: Settling = field(default_factory=Settling)
    clearance: TripodClearance | None = None
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        checked_name(self.name, "stage")
        if self.protocol != "ptu46" and self.pan.module == self.tilt.module:
            raise InvalidInput(
                f"both axes of stage '{self.name}' have the address {self.pan.module}: give each module "
                "its own"
            )
        if self.protocol == "powercube" and max(self.pan.module, self.tilt.module) > 31:
            raise InvalidInput(f"stage '{self.name}': PowerCubes have addresses from 1 to 31")
        if self.start == "on-signal" and self.protocol != "powercube":
            raise InvalidInput(
                f"stage '{self.name}' cannot start on a signal: only PowerCubes can; write start = 'together'"
            )
        if self.unit_rad <= 0.0 or self.backlash_rad < 0.0:
            raise InvalidInput(
                f"stage '{self.name}' needs a positive unit_rad and a backlash_rad of 0 or more"
            )


@dataclass(frozen=True)
class TriggerController:
    """A box that triggers cameras, strobes or projectors.

    Attributes
    ----------
    wiring
        Its outputs and the sensors on them.
    configure
        Requests sent one after the other when it is connected.
    select, trigger
        Requests in which `{output}` is replaced, also with a format such as `{output:02d}`; an empty `select`
        is not sent.
    """

    name: str
    link: SerialLink
    protocol: LineProtocol
    wiring: tuple[Wire, ...]
    trigger: str
    select: str = ""
    configure: tuple[str, ...] = ()
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        checked_name(self.name, "trigger controller")
        _check_wiring(self.name, self.wiring)
        _check_requests(self.name, (self.trigger, self.select))
        _check_faults(self.name, self.faults)


@dataclass(frozen=True)
class VideoSplitter:
    """A switch that feeds one video signal to one projector at a time.

    Attributes
    ----------
    wiring
        Its outputs and the projectors on them.
    select
        The request that switches; `{output}` is replaced.
    settle_s
        How long a projector needs to show the picture after it was switched to.
    """

    name: str
    link: SerialLink
    protocol: LineProtocol
    wiring: tuple[Wire, ...]
    select: str
    settle_s: float = 0.0
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        checked_name(self.name, "video splitter")
        _check_wiring(self.name, self.wiring)
        _check_requests(self.name, (self.select,))
        _check_faults(self.name, self.faults)
        if self.settle_s < 0.0:
            raise InvalidInput(f"video splitter '{self.name}' cannot settle in {self.settle_s} s")


@dataclass(frozen=True)
class SerialChannel:
    """A scalar that an instrument tells on a serial line: load, displacement, temperature.

    Attributes
    ----------
    request
        What is sent to get a value; empty for an instrument that sends values by itself.
    reply
        Regular expression with the group `value`, and perhaps `unit`.
    reported_unit
        What `unit` must read; a reading in another unit is refused.
    unit
        Of the result, such as N, mm or degC.
    scale, offset
        Result = scale x value + offset.
    """

    name: str
    link: SerialLink
    protocol: LineProtocol
    unit: str
    request: str = ""
    reply: str = r"(?P<value>[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)"
    reported_unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        checked_name(self.name, "channel")
        check_pattern(self.reply, f"reply of channel '{self.name}'", group="value")
        _check_scale(self.name, self.scale, self.offset)
        _check_faults(self.name, self.faults)
        if self.reported_unit and "(?P<unit>" not in self.reply:
            raise InvalidInput(
                f"channel '{self.name}' says which unit must be reported, but its reply has no group 'unit'"
            )


@dataclass(frozen=True)
class FileChannel:
    """A scalar in the last line of a CSV file that other software appends to.

    Attributes
    ----------
    path
        Of the file.
    column
        Its heading; or, for a file without headings, its number from 1.
    delimiter, decimal
        Between columns, and between whole and fraction.
    stale_after_s
        A file that was last written longer ago is no reading; 0 if any age will do.
    """

    name: str
    path: str
    column: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    delimiter: str = ","
    decimal: str = "."
    stale_after_s: float = 5.0

    def __post_init__(self) -> None:
        checked_name(self.name, "channel")
        _check_scale(self.name, self.scale, self.offset)
        if len(self.delimiter) != 1 or len(self.decimal) != 1 or self.delimiter == self.decimal:
            raise InvalidInput(
                f"channel '{self.name}' needs one character between columns and another one for decimals, "
                f"not {self.delimiter!r} and {self.decimal!r}"
            )


@dataclass(frozen=True)
class Instruments:
    """All instruments of a rig that have a wire or a file of their own; names and ports are unique."""

    stages: tuple[Stage, ...] = ()
    triggers: tuple[TriggerController, ...] = ()
    splitters: tuple[VideoSplitter, ...] = ()
    channels: tuple[SerialChannel | FileChannel, ...] = ()

    def __post_init__(self) -> None:
        names = [d.name for d in (*self.stages, *self.triggers, *self.splitters, *self.channels)]
        for name in names:
            if names.count(name) > 1:
                raise InvalidInput(
                    f"{names.count(name)} instruments are called '{name}': give each its own name"
                )
        users: dict[str, str] = {}
        for device in self.serial:
            port = device.link.port
            if port != SIMULATED and port in users:
                raise InvalidInput(
                    f"'{users[port]}' and '{device.name}' both use port {port}: a port belongs to one "
                    "instrument"
                )
            users[port] = device.name

    @property
    def serial(self) -> tuple[Stage | TriggerController | VideoSplitter | SerialChannel, ...]:
        """Those that are reached through a serial link."""
        channels = tuple(c for c in self.channels if isinstance(c, SerialChannel))
        return (*self.stages, *self.triggers, *self.splitters, *channels)

    def at(self, state: str) -> Instruments:
        """Return them with those faults alone that they have at a load state; "" for no state."""
        return Instruments(
            tuple(replace(s, faults=_at(s.faults, state)) for s in self.stages),
            tuple(replace(t, faults=_at(t.faults, state)) for t in self.triggers),
            tuple(replace(s, faults=_at(s.faults, state)) for s in self.splitters),
            tuple(
                replace(c, faults=_at(c.faults, state)) if isinstance(c, SerialChannel) else c
                for c in self.channels
            ),
        )


def _at(faults: tuple[Fault, ...], state: str) -> tuple[Fault, ...]:
    return tuple(f for f in faults if f.state in ("", state))


def _check_wiring(name: str, wiring: tuple[Wire, ...]) -> None:
    sensors = [wire.sensor for wire in wiring]
    if not wiring or len(set(sensors)) != len(sensors):
        raise InvalidInput(
            f"'{name}' needs wires, each to another sensor; it has {', '.join(sensors) or 'none'}"
        )


def _check_requests(name: str, requests: tuple[str, ...]) -> None:
    for request in requests:
        if not request.isascii() or not REQUEST.fullmatch(request):
            raise InvalidInput(
                f"'{name}' cannot send {request!r}: a request is ASCII text in which only {{output}} is "
                "replaced, or {output:02d} for two digits"
            )


def _check_scale(name: str, scale: float, offset: float) -> None:
    if not (isfinite(scale) and isfinite(offset)) or scale == 0.0:
        raise InvalidInput(
            f"channel '{name}' has scale {scale} and offset {offset}: numbers, and no scale of 0, are needed"
        )


def _check_faults(name: str, faults: tuple[Fault, ...]) -> None:
    for fault in faults:
        if fault.fault not in LINK_FAULTS:
            raise InvalidInput(f"'{name}' has no axes and cannot have the fault {fault.fault}")
