"""Two axes as a pan-tilt stage uses them, whichever protocol they speak."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

AxisName = Literal["pan", "tilt"]
AXES: tuple[AxisName, AxisName] = ("pan", "tilt")


@dataclass(frozen=True)
class AxisState:
    """What an axis says of itself.

    Attributes
    ----------
    position_rad
        Where it is.
    moving, homed
        Whether it moves, and knows where it is.
    fault
        A sentence on what is wrong and what to do; empty when nothing is.
    """

    position_rad: float
    moving: bool
    homed: bool
    fault: str = ""


class Axes(Protocol):
    """A driver of two axes. Each method returns when the modules have accepted, not when they arrive.

    All raise `LinkLost` when a module does not answer and `DeviceFault` when it refuses.
    """

    def open(self) -> tuple[str, ...]:
        """Greet the modules, clear old errors, set limits and velocities; return what they are."""
        ...

    def state(self, axis: AxisName) -> AxisState:
        """Return the present state."""
        ...

    def resolution_rad(self, axis: AxisName) -> float:
        """Return the angle between positions that can be told apart; 0 where it is fine enough to forget."""
        ...

    def home(self, axis: AxisName) -> None:
        """Begin to look for the home position."""
        ...

    def move(self, targets_rad: Mapping[AxisName, float]) -> None:
        """Begin to move to positions."""
        ...

    def stop(self) -> None:
        """Stand still at once."""
        ...

    def clear(self) -> None:
        """Clear errors that can be cleared."""
        ...

    def close(self) -> None:
        """Let go of the wire."""
        ...
