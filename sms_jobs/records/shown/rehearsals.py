"""What recording states of a campaign would take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class StateRehearsal:
    """What recording a state takes.

    Attributes
    ----------
    moving_s
        Until the instruments are connected and the stage stands in its pose.
    recording_s
        All sets, from the first pattern to the last reading of a channel.
    frames
        Of all views, the white ones too.
    raw_bytes, set_bytes
        Of these frames, and of those that are recorded again together if need be, where they are most.
    problem
        Why the stage cannot take its pose, in words; empty where it can.
    """

    moving_s: float
    recording_s: float
    frames: int
    raw_bytes: int
    set_bytes: int
    problem: str = ""

    @property
    def seconds(self) -> float:
        """How long the specimen has to be held, or the artefact to stand."""
        return self.moving_s + self.recording_s


@dataclass(frozen=True)
class DryRun:
    """What recording some states would take.

    Attributes
    ----------
    states
        By label, in order.
    packed
        What these views take in the archive, as a fraction of their raw frames, by what this rig's took
        before; None where there is none of their sort yet.
    unpacked
        The same if nothing can be packed.
    spool_bytes, spool_room
        What one state needs of the spool's disk, at most, and what is free there.
    archive_room
        What is free on the archive's disk.
    missing
        What keeps these states from being recorded, in words.
    remarks
        What is as the plan says and yet worth knowing.
    ways
        How the patterns of each projector come before its cameras, in words.
    """

    states: dict[str, StateRehearsal]
    packed: float | None
    spool_bytes: int
    spool_room: int
    archive_room: int
    missing: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    unpacked: float = 1.0
    ways: Mapping[str, str] = field(default_factory=dict)

    @property
    def seconds(self) -> float:
        """Of all states, nothing between them."""
        return sum(s.seconds for s in self.states.values())

    @property
    def frames(self) -> int:
        """Of all states."""
        return sum(s.frames for s in self.states.values())

    @property
    def raw_bytes(self) -> int:
        """Of all states."""
        return sum(s.raw_bytes for s in self.states.values())

    @property
    def archived_bytes(self) -> int:
        """Of all states in the archive."""
        return self.archived(self.raw_bytes)

    def archived(self, raw_bytes: int) -> int:
        """Return what raw frames take in the archive, at most where nothing is known of packing."""
        return round(raw_bytes * (self.unpacked if self.packed is None else self.packed))
