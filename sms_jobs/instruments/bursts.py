"""Patterns that a projector plays by itself, while its pulses expose cameras that were armed once for all.

What came of it counts as a whole: a frame that is missing, doubled or late may show another pattern than its
place says, so that all are taken again. The cameras' own numbers and times tell, while frames come in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TypeAlias

from sms_jobs.errors import FrameLost, InstrumentError
from sms_jobs.instruments.protocols import BurstCamera, Frame, SequencedProjector
from sms_jobs.records.bursts import Burst

_UNEVEN = 0.01
"""Part of the period that a frame may be early or late by: at most so much of its light is of a neighbour."""

_LEAST_WAIT_S = 0.05
"""For a frame too many, of short periods: a computer may be busy for so long."""

Seen: TypeAlias = dict[str, Frame]
"""What every camera saw of a pattern, by its name."""


@dataclass(frozen=True)
class Players:
    """Who takes part in a burst.

    Attributes
    ----------
    projector
        That plays.
    cameras
        That its pulses expose, by name.
    """

    projector: SequencedProjector
    cameras: Mapping[str, BurstCamera]

    def stop(self) -> None:
        """Leave the projector dark and the cameras disarmed, whatever state they are in."""
        for end in (self.projector.dark, *(camera.disarm for camera in self.cameras.values())):
            with suppress(InstrumentError):
                end()


def played(players: Players, burst: Burst, timeout_s: float, progress: Callable[[int], None]) -> list[Seen]:
    """Play a burst and return what every camera saw of each pattern, in order.

    Parameters
    ----------
    timeout_s
        How long a frame is waited for after its pulse was due.
    progress
        Told how many patterns have been seen; may raise to stop.

    Raises
    ------
    FrameLost
        A frame is missing, doubled or late, or the projector stopped: nothing of the burst can be used.
    InstrumentError
        An instrument gives up.
    """
    with ExitStack() as ending:
        ending.callback(players.stop)
        for camera in players.cameras.values():
            camera.arm_burst(burst)
        players.projector.play(burst)
        found: list[Seen] = []
        due_s = timeout_s + burst.lead_s
        while len(found) < burst.frames:
            found.append({name: _next(players, name, found, burst, due_s) for name in players.cameras})
            due_s = timeout_s + burst.period_s
            progress(len(found))
        _require_no_more(players, burst)
        players.projector.wait()
    return found


def _require_no_more(players: Players, burst: Burst) -> None:
    """Raise `FrameLost` when another frame comes: all before it may then be those of the pattern before.

    Frames arrive a period apart, whatever each takes on its way; so another one is there after two of them.
    """
    waiting_s = max(2.0 * burst.period_s, _LEAST_WAIT_S)
    for name, camera in players.cameras.items():
        if left := camera.left_over(waiting_s):
            raise FrameLost(f"camera {name} delivered {burst.frames + left} frames for {burst.frames} pulses")
        waiting_s = 0.0  # the others have had as long


def _next(players: Players, name: str, before: list[Seen], burst: Burst, due_s: float) -> Frame:
    """Return the next frame of a camera; raise `FrameLost` when there is none, or it is not the next."""
    try:
        frame = players.cameras[name].read(due_s)
    except FrameLost as error:
        words = f"camera {name} delivered {len(before)} of {burst.frames} frames of a burst ({error})"
        try:
            players.projector.wait()
        except FrameLost as stopped:
            words = f"{stopped}, and {words}"
        raise FrameLost(words) from error
    if before:
        _require_next(name, len(before), before[-1][name], frame, burst)
    return frame


def _require_next(name: str, place: int, before: Frame, frame: Frame, burst: Burst) -> None:
    """Raise `FrameLost` for a frame that is not the next one by its number, or not by its time."""
    where = f"after frame {place} of a burst of {burst.frames}"
    if frame.number != before.number + 1:
        raise FrameLost(
            f"camera {name} went from frame {before.number} to {frame.number} {where}, lost on the way"
        )
    periods = (frame.time_s - before.time_s) / burst.period_s
    if abs(periods - 1.0) <= _UNEVEN:
        return
    what = (
        "missed a pulse" if periods > 1.5 else "was exposed twice" if periods < 2 / 3 else "was not in step"
    )
    raise FrameLost(
        f"camera {name} {what} {where}: the next came {1e3 * periods * burst.period_s:.4g} ms later, and "
        f"pulses are {1e3 * burst.period_s:.4g} ms apart"
    )
