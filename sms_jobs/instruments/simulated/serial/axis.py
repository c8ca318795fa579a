"""A simulated axis: ramps, homing, limits, a servo that drifts a little, and faults on purpose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import copysign, exp, pi, radians, sin, sqrt
from typing import Literal

from sms_jobs.records.serial_links import Fault

Phase = Literal["rest", "accelerate", "steady", "decelerate"]

_DRIFT_RAD = radians(0.03)
_DRIFT_TIME_S = 0.1
"""After a move the servo is off by so much, and comes in with this time constant."""
_HUNTS_EVERY_S = 1.7
_AT_POWER_ON_RAD = 0.2
_SWITCH_RAD = -0.3
"""Where the reference switch is: homing goes there first."""


@dataclass(frozen=True)
class Ramp:
    """A move with equal ramps up and down, or a triangle where it is too short for the velocity.

    Attributes
    ----------
    begins
        When, in s.
    start, end
        In rad.
    velocity, acceleration
        Positive, in rad/s and rad/s^2.
    """

    begins: float
    start: float
    end: float
    velocity: float
    acceleration: float

    @property
    def ramp_s(self) -> float:
        """How long either ramp takes."""
        distance = abs(self.end - self.start)
        return min(self.velocity / self.acceleration, sqrt(distance / self.acceleration))

    @property
    def steady_s(self) -> float:
        """How long it goes at the highest velocity."""
        distance = abs(self.end - self.start)
        return max(0.0, distance / self.velocity - self.velocity / self.acceleration)

    @property
    def ends(self) -> float:
        """When it is over."""
        return self.begins + 2.0 * self.ramp_s + self.steady_s

    def position(self, now: float) -> float:
        """Return where the axis is."""
        if now <= self.begins:
            return self.start
        if now >= self.ends:
            return self.end
        sign = copysign(1.0, self.end - self.start)
        since, left = now - self.begins, self.ends - now
        if since <= self.ramp_s:
            return self.start + sign * 0.5 * self.acceleration * since**2
        if left <= self.ramp_s:
            return self.end - sign * 0.5 * self.acceleration * left**2
        ramp = 0.5 * self.acceleration * self.ramp_s**2
        return self.start + sign * (ramp + self.acceleration * self.ramp_s * (since - self.ramp_s))

    def phase(self, now: float) -> Phase:
        """Return which part of the move it is in."""
        if not self.begins <= now < self.ends:
            return "rest"
        if now - self.begins < self.ramp_s:
            return "accelerate"
        return "decelerate" if self.ends - now <= self.ramp_s else "steady"


@dataclass
class SimulatedAxis:
    """An axis with a servo.

    Attributes
    ----------
    minimum_rad, maximum_rad, velocity_rad_s, acceleration_rad_s2
        May be changed at any time, for the moves to come.
    increment_rad
        Of its encoder.
    faults
        Those of axes are committed here.
    homed
        Whether it has found its home position since it was switched on.
    tow_error, beyond_soft_limit
        Errors that stand until they are cleared.
    """

    minimum_rad: float
    maximum_rad: float
    velocity_rad_s: float
    acceleration_rad_s2: float
    increment_rad: float = radians(1.0 / 672.0)
    faults: Sequence[Fault] = ()
    homed: bool = False
    tow_error: bool = False
    beyond_soft_limit: bool = False
    _ramps: list[Ramp] = field(default_factory=lambda: [Ramp(0.0, 0.0, _AT_POWER_ON_RAD, 1e9, 1e18)])
    _moves: int = 0
    _homings: int = 0
    _homes_at: float | None = None
    _fails_at: float | None = None
    _failure: str = ""
    _hunts_rad: float = 0.0

    def move(self, target_rad: float, now: float) -> bool:
        """Begin a move; return False, and stay, where the target is out of range or an error stands."""
        self.advance(now)
        if self.tow_error or self._blocked(target_rad, now):
            return False
        self._moves += 1
        self._hunts_rad = 0.0
        start = self.servo(now)
        end, failure = target_rad, ""
        for fault in self.faults:
            if not fault.befalls(self._moves):
                continue
            if fault.fault in ("tow-error", "soft-limit"):
                end, failure = 0.5 * (start + target_rad), fault.fault
            elif fault.fault == "hunting-servo":
                self._hunts_rad = fault.amount or radians(0.1)
        self._ramps = [Ramp(now, start, end, self.velocity_rad_s, self.acceleration_rad_s2)]
        self._failure, self._fails_at = failure, self._ramps[-1].ends if failure else None
        return True

    def home(self, now: float) -> None:
        """Begin to look for the home position: to the switch, then to 0."""
        self.advance(now)
        self._homings += 1
        self.homed = False
        self._hunts_rad = 0.0
        velocity, acceleration = self.velocity_rad_s, self.acceleration_rad_s2
        out = Ramp(now, self.servo(now), _SWITCH_RAD, velocity, acceleration)
        never = any(f.fault == "never-homed" and f.befalls(self._homings) for f in self.faults)
        back = Ramp(out.ends, _SWITCH_RAD, 0.0, velocity, acceleration)
        self._ramps = [out] if never else [out, back]
        self._homes_at = None if never else back.ends

    def stop(self, now: float) -> None:
        """Stand still at once."""
        self.advance(now)
        here = self.servo(now)
        self._ramps = [Ramp(now, here, here, self.velocity_rad_s, self.acceleration_rad_s2)]
        self._homes_at = self._fails_at = None

    def clear(self) -> None:
        """Clear the errors."""
        self.tow_error = self.beyond_soft_limit = False

    def advance(self, now: float) -> None:
        """Let happen what happens until now."""
        if self._homes_at is not None and now >= self._homes_at:
            self.homed, self._homes_at = True, None
        if self._fails_at is not None and now >= self._fails_at:
            self._fails_at = None
            self.tow_error |= self._failure == "tow-error"
            self.beyond_soft_limit |= self._failure == "soft-limit"

    def moving(self, now: float) -> bool:
        """Return whether a move or homing is under way."""
        return now < self._ramps[-1].ends

    @property
    def ends(self) -> float:
        """When the last move ends or ended."""
        return self._ramps[-1].ends

    @property
    def travels_rad(self) -> float:
        """How far the last move goes."""
        return abs(self._ramps[-1].end - self._ramps[0].start)

    def phase(self, now: float) -> Phase:
        """Return the part of the move that it is in."""
        return next((r.phase(now) for r in self._ramps if r.phase(now) != "rest"), "rest")

    def servo(self, now: float) -> float:
        """Return where the controller wants the axis to be, in rad."""
        return next((r.position(now) for r in self._ramps if now < r.ends), self._ramps[-1].end)

    def true_position(self, now: float) -> float:
        """Return where the axis is, in rad: as a camera would see it."""
        since = now - self.ends
        if since < 0.0:
            return self.servo(now)
        drift = _DRIFT_RAD * exp(-since / _DRIFT_TIME_S) if self.travels_rad > 0.0 else 0.0
        return self.servo(now) + drift + self._hunts_rad * sin(2.0 * pi * since / _HUNTS_EVERY_S)

    def position(self, now: float) -> float:
        """Return what the encoder tells, in rad."""
        return self.increment_rad * round(self.true_position(now) / self.increment_rad)

    def _blocked(self, target_rad: float, now: float) -> bool:
        margin = 0.5 * self.increment_rad
        if self.minimum_rad - margin <= target_rad <= self.maximum_rad + margin:
            return False
        self.beyond_soft_limit = True
        return True
