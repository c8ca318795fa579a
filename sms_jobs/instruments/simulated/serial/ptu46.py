"""A PTU-46 pan-tilt unit behind its bytes."""

from __future__ import annotations

import re
from collections.abc import Mapping

from sms_jobs.instruments.codecs.lines import LineDecoder
from sms_jobs.instruments.codecs.ptu46 import radians_per_count
from sms_jobs.instruments.simulated.serial.axis import SimulatedAxis

SECONDS_OF_ARC = 185.1428
"""Resolution of the unit: 0.0514 degrees a count."""
COUNT_RAD = radians_per_count(SECONDS_OF_ARC)
_SLOWEST, _FASTEST = 0, 2902
_COMMAND = re.compile(r"(?P<axis>[pt])(?P<name>[rnxluspa])(?P<value>[-+]?\d+)?")
_AXES = {"p": "pan", "t": "tilt"}


class SimulatedPtu46:
    """A unit that refers itself when it is switched on.

    Parameters
    ----------
    axes
        `pan` and `tilt`.
    """

    def __init__(self, axes: Mapping[str, SimulatedAxis]) -> None:
        self._axes = dict(axes)
        for axis in self._axes.values():
            axis.increment_rad = COUNT_RAD
            axis.homed = True
        self._decoder = LineDecoder(" ")

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes and return the replies."""
        return [f"{self._answer(text, now)}\n".encode("ascii") for text in self._decoder.feed(data) if text]

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        """Return nothing: the unit speaks when it is asked."""
        return []

    def next_event(self) -> float | None:
        """Return None: it never speaks unasked."""
        return None

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        """Return a garbled reply: the protocol has no checksum."""
        return bytes((reply[0] ^ 0x80,)) + reply[1:]

    def _answer(self, text: str, now: float) -> str:
        text = text.lower()
        if text in ("ft", "ed", "ci"):
            return "*"
        if text == "h":
            for axis in self._axes.values():
                axis.stop(now)
            return "*"
        match = _COMMAND.fullmatch(text)
        if match is None:
            return "! Illegal command"
        axis = self._axes[_AXES[match["axis"]]]
        if match["value"] is not None:
            return self._set(axis, match["name"], int(match["value"]), now)
        return f"* {self._tell(axis, match['name'], now)}"

    def _tell(self, axis: SimulatedAxis, name: str, now: float) -> str:
        if name == "r":
            return f"{SECONDS_OF_ARC:.4f}"
        counts = {
            "n": int(axis.minimum_rad / COUNT_RAD),
            "x": int(axis.maximum_rad / COUNT_RAD),
            "l": _SLOWEST,
            "u": _FASTEST,
            "s": round(axis.velocity_rad_s / COUNT_RAD),
            "a": round(axis.acceleration_rad_s2 / COUNT_RAD),
            "p": round(axis.position(now) / COUNT_RAD),
        }
        return str(counts[name])

    def _set(self, axis: SimulatedAxis, name: str, value: int, now: float) -> str:
        if name == "p":
            if not int(axis.minimum_rad / COUNT_RAD) <= value <= int(axis.maximum_rad / COUNT_RAD):
                return f"! Maximum allowable position is {int(axis.maximum_rad / COUNT_RAD)}"
            # An axis that stalled does not say so: it only does not arrive.
            axis.clear()
            axis.move(value * COUNT_RAD, now)
        elif name == "s" and _SLOWEST < value <= _FASTEST:
            axis.velocity_rad_s = value * COUNT_RAD
        elif name == "a" and value > 0:
            axis.acceleration_rad_s2 = value * COUNT_RAD
        else:
            return f"! {value} is out of range"
        return "*"
