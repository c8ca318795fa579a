"""The pan-tilt stage as recipes use it (thesis 3.2.2, middle level, and 3.2.3)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Generator, Iterator, Mapping
from contextlib import suppress
from math import ceil, floor, pi

from sms_jobs.errors import DeviceFault, InstrumentError, LimitExceeded
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.devices.clearance import tilt_range
from sms_jobs.instruments.devices.device import POLLS_EVERY_S, Description, Status
from sms_jobs.instruments.drivers.axes import AXES, Axes, AxisName, AxisState
from sms_jobs.instruments.operation_log import OperationLog
from sms_jobs.metrology.geometry.stage_poses import AngleRange, StagePose
from sms_jobs.records.instruments import Axis, Stage
from sms_jobs.records.operations import Reading

_TURN = 2.0 * pi
_MARGIN_S = 5.0
"""What a move may take longer than its profile."""
_HOMING_S = 120.0
_STANDS_S = 1.0
"""An axis that stands so long without being homed has not found its home position."""

_logger = logging.getLogger(__name__)


class PanTilt:
    """A stage of two axes, whichever protocol they speak. Angles are in rad; 315 degrees are -45 degrees.

    Parameters
    ----------
    stage
        Its limits, profile and tolerances.
    axes
        The driver.
    log
        Of operations.

    Attributes
    ----------
    ranges
        Where the axes may go, by name: within their own limits, and those of bar and tripod.
    """

    def __init__(self, stage: Stage, axes: Axes, clock: Clock, log: OperationLog | None = None) -> None:
        self._stage = stage
        self._axes = axes
        self._clock = clock
        self._log = log or OperationLog(clock)
        self._facts: tuple[str, ...] = ()
        self._stopped = threading.Event()
        low, high = stage.tilt.minimum_rad, stage.tilt.maximum_rad
        if stage.clearance is not None:
            low, high = tilt_range(stage.clearance, low, high)
        self.ranges: dict[AxisName, AngleRange] = {
            "pan": AngleRange(stage.pan.minimum_rad, stage.pan.maximum_rad),
            "tilt": AngleRange(low, high),
        }

    @property
    def name(self) -> str:
        """Its name in the rig."""
        return self._stage.name

    def connect(self) -> None:
        """Greet the modules, clear old errors, set limits and velocities."""
        with self._log.operation(self.name, "connect"):
            self._facts = self._axes.open()

    def close(self) -> None:
        """Let go of it."""
        self._axes.close()

    def describe(self) -> Description:
        """Return what it is and where it may go."""
        ranges = tuple(
            f"{axis}: {r.minimum_rad:.4f} .. {r.maximum_rad:.4f} rad" for axis, r in self.ranges.items()
        )
        units = (("pan_rad", "rad"), ("tilt_rad", "rad"))
        return Description(self.name, f"pan-tilt stage ({self._stage.protocol})", self._facts + ranges, units)

    def read(self) -> tuple[Reading, ...]:
        """Return `pan_rad` and `tilt_rad`."""
        return tuple(
            Reading(f"{axis}_rad", self._axes.state(axis).position_rad, "rad", self._clock.now())
            for axis in AXES
        )

    def angles(self) -> tuple[float, float]:
        """Return pan and tilt as the stage reads them, in rad."""
        pan, tilt = self.read()
        return pan.value, tilt.value

    def known_angles(self) -> tuple[float, float] | None:
        """Return pan and tilt in rad; None when an axis has not been home, whose angles mean nothing."""
        pan, tilt = (self._axes.state(axis) for axis in AXES)
        return (pan.position_rad, tilt.position_rad) if pan.homed and tilt.homed else None

    def stage(self) -> None:
        """Make ready for poses: look for the home position where an axis does not know it."""
        self._ready()
        if self.known_angles() is None:
            self.reference()

    def stop(self) -> None:
        """Stand still at once; a move that is under way ends with `DeviceFault`. May come from any thread."""
        self._stopped.set()
        with self._log.operation(self.name, "stop"):
            self._axes.stop()

    def recover(self) -> None:
        """Clear errors after whatever caused them was removed.

        Raises
        ------
        DeviceFault
            An error stands that cannot be cleared.
        """
        with self._log.operation(self.name, "recover"):
            self._axes.clear()
            for axis in AXES:
                self._check(axis, self._axes.state(axis))
        self._stopped.clear()

    def set(self, value: StagePose) -> Status:
        """Begin to go to a pose; it is over when the servos have settled there.

        Raises
        ------
        LimitExceeded
            The pose is out of reach, or the bar would meet the tripod there.
        """
        self._ready()
        targets = self._targets(value)
        detail = ", ".join(f"{axis} {target:.5f} rad" for axis, target in targets.items())
        end = self._log.begin(self.name, "move", detail)
        longest = self._stage.settling.attempts * (
            3.0 * sum(self._move_s(axis, self.ranges[axis].width_rad) for axis in AXES)
            + self._stage.settling.timeout_s
        )
        return Status(f"'{self.name}' to move ({detail})", self._go(targets), self._clock, longest, end)

    def move(self, pan_rad: float, tilt_rad: float) -> None:
        """Go to a pose and return when it stands still; see `set`."""
        self.set(StagePose(pan_rad, tilt_rad)).wait()

    def home(self) -> None:
        """Go back to 0 the way the pan axis came, so that the cable uncoils; look for 0 if it is lost."""
        self._ready()
        if self.known_angles() is not None:
            self.move(0.0, 0.0)
        else:
            self.reference()

    def reference(self) -> None:
        """Look for the home position of one axis after the other, the tilt axis first: then the bar is level.

        Raises
        ------
        DeviceFault
            An axis does not find it.
        """
        self._ready()
        with self._log.operation(self.name, "reference"):
            for axis in reversed(AXES):
                self._axes.home(axis)
                Status(f"'{self.name}' to home", self._homing(axis), self._clock, _HOMING_S).wait()

    def _ready(self) -> None:
        """Clear what a stop left behind."""
        if self._stopped.is_set():
            self.recover()

    def _targets(self, pose: StagePose) -> dict[AxisName, float]:
        targets = {}
        for axis, requested in zip(AXES, (pose.pan_rad, pose.tilt_rad), strict=True):
            valid = self.ranges[axis]
            slack = 1e-9
            turns = range(
                ceil((valid.minimum_rad - slack - requested) / _TURN),
                floor((valid.maximum_rad + slack - requested) / _TURN) + 1,
            )
            if not turns:
                own = self._axis(axis)
                cause = (
                    "where the bar would meet the tripod"
                    if own.minimum_rad <= requested <= own.maximum_rad
                    else "beyond its range"
                )
                raise LimitExceeded(
                    f"the {axis} axis of '{self.name}' is sent to {requested:.4f} rad, {cause}: it may "
                    f"go from {valid.minimum_rad:.4f} to {valid.maximum_rad:.4f} rad"
                )
            nearest = min((requested + turn * _TURN for turn in turns), key=abs)
            targets[axis] = min(max(nearest, valid.minimum_rad), valid.maximum_rad)
        return targets

    def _go(self, targets: Mapping[AxisName, float]) -> Iterator[float]:
        settling = self._stage.settling
        for attempt in range(1, settling.attempts + 1):
            for leg in self._legs(targets):
                one_by_one = self._stage.start == "one-after-the-other"
                groups = [{axis: target} for axis, target in leg.items()] if one_by_one else [leg]
                for group in groups:
                    yield from self._drive(group)
            drift = yield from self._settle(targets)
            if not drift:
                return
            hunting = " and ".join(f"{axis} is off by up to {error:.2e} rad" for axis, error in drift.items())
            _logger.warning(
                "the servo of '%s' hunts, attempt %d of %d: %s",
                self.name, attempt, settling.attempts, hunting,
            )  # fmt: skip
        raise DeviceFault(
            f"the servo of '{self.name}' hunts: after {settling.attempts} attempts of {settling.timeout_s:g} "
            f"s {hunting}, more than {settling.tolerance_rad:.2e} rad; lighten the bar, wait, or widen the "
            "tolerance"
        )

    def _legs(self, targets: Mapping[AxisName, float]) -> Iterator[Mapping[AxisName, float]]:
        """Yield the moves that end at the targets from below: the gears' play is always on one side."""
        play = self._stage.backlash_rad
        if play > 0.0:
            below = {
                axis: max(target - play, self.ranges[axis].minimum_rad)
                for axis, target in targets.items()
                if target < self._axes.state(axis).position_rad
            }
            if below:
                yield {**targets, **below}
        yield targets

    def _drive(self, targets: Mapping[AxisName, float]) -> Iterator[float]:
        before = {axis: self._axes.state(axis).position_rad for axis in targets}
        limit = self._clock.monotonic() + sum(
            self._move_s(axis, abs(target - before[axis])) for axis, target in targets.items()
        )
        self._axes.move(targets)
        whole = sum(abs(target - before[axis]) for axis, target in targets.items())
        moving = True
        while moving:
            self._raise_if_stopped()
            states = {axis: self._axes.state(axis) for axis in targets}
            for axis, state in states.items():
                self._check(axis, state)
            moving = any(state.moving for state in states.values())
            left = sum(abs(target - states[axis].position_rad) for axis, target in targets.items())
            if moving and self._clock.monotonic() > limit:
                self._axes.stop()
                raise DeviceFault(
                    f"'{self.name}' is still {left:.3f} rad from its pose when it should have arrived: see "
                    "what blocks it, then recover and reference it"
                )
            yield 0.9 * (1.0 - left / whole) if whole > 0.0 else 0.9

    def _settle(self, targets: Mapping[AxisName, float]) -> Generator[float, None, dict[AxisName, float]]:
        """Wait until both axes stay at their targets; return by how much those that do not are off."""
        settling = self._stage.settling
        deadline = self._clock.monotonic() + settling.timeout_s
        since: float | None = None
        recent: list[tuple[float, dict[AxisName, float]]] = []
        while True:
            self._raise_if_stopped()
            errors = {}
            for axis, target in targets.items():
                state = self._axes.state(axis)
                self._check(axis, state)
                errors[axis] = abs(state.position_rad - target)
            now = self._clock.monotonic()
            recent = [(t, e) for t, e in recent if now - t < 0.5 * settling.timeout_s] + [(now, errors)]
            off = {axis for axis in AXES if axis in errors and errors[axis] > self._tolerance(axis)}
            since = None if off else since if since is not None else now
            if since is not None and now - since >= settling.for_s:
                return {}
            if now > deadline:
                worst = {axis: max(e[axis] for _, e in recent) for axis in errors}
                return {
                    axis: error for axis, error in worst.items() if error > self._tolerance(axis)
                } or errors
            yield 0.9 if since is None else 0.9 + 0.1 * (now - since) / settling.for_s

    def _homing(self, axis: AxisName) -> Iterator[float]:
        stood_since: float | None = None
        while True:
            self._raise_if_stopped()
            state = self._axes.state(axis)
            self._check(axis, state)
            if state.homed and not state.moving:
                return
            now = self._clock.monotonic()
            stood_since = None if state.moving else stood_since if stood_since is not None else now
            if stood_since is not None and now - stood_since > _STANDS_S:
                raise DeviceFault(
                    f"the {axis} axis of '{self.name}' stands at {state.position_rad:.3f} rad and has not "
                    "found its home position: check its reference switch, and that nothing blocks it"
                )
            yield 0.5

    def _check(self, axis: AxisName, state: AxisState) -> None:
        if not state.fault:
            return
        with suppress(InstrumentError):  # the fault says more than that it cannot be stopped either
            self._axes.stop()
        raise DeviceFault(
            f"the {axis} axis of '{self.name}' stopped at {state.position_rad:.4f} rad: {state.fault}"
        )

    def _raise_if_stopped(self) -> None:
        if self._stopped.is_set():
            raise DeviceFault(f"'{self.name}' was stopped on its way: recover it, then move again")

    def _tolerance(self, axis: AxisName) -> float:
        # A position between two counts of the encoder is reached by the nearer one.
        return self._stage.settling.tolerance_rad + 0.5 * self._axes.resolution_rad(axis)

    def _move_s(self, axis: AxisName, distance: float) -> float:
        limits = self._axis(axis)
        ramps = limits.velocity_rad_s / limits.acceleration_rad_s2
        return 1.5 * (distance / limits.velocity_rad_s + 2.0 * ramps) + _MARGIN_S + POLLS_EVERY_S

    def _axis(self, axis: AxisName) -> Axis:
        return self._stage.pan if axis == "pan" else self._stage.tilt
