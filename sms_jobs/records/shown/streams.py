"""What a stream of frames would take, and what came of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class StreamRehearsal:
    """What a stream would take.

    Attributes
    ----------
    cameras
        By name.
    frames, states
        Of each camera, and how many of those moments become states.
    seconds
        How long the part is that is kept.
    ring_bytes, memory_room
        What frames take that wait in memory, and half of what is free there.
    spool_bytes, spool_room
        What the frames need of the spool's disk, and what is free there.
    archived_bytes, archive_room
        What they need of the archive's disk if nothing can be packed, and what is free there.
    missing
        What keeps it from being streamed, in words.
    """

    cameras: tuple[str, ...]
    frames: int
    states: int
    seconds: float
    ring_bytes: int
    memory_room: int
    spool_bytes: int
    spool_room: int
    archived_bytes: int
    archive_room: int
    missing: tuple[str, ...]


@dataclass(frozen=True)
class StreamedCamera:
    """What came of the frames of a camera.

    Attributes
    ----------
    moments
        At which it was exposed, from the first that is kept to the last.
    whole
        Moments of which there is a frame of every camera.
    states
        Of those, how many became states.
    late
        Moments at which nothing was exposed, because what came before took too long.
    lost, refused
        Frames that it did not deliver, and that had no room in memory because the disk was too slow.
    doubted
        States whose image is doubted.
    """

    moments: int
    whole: int
    states: int
    late: int
    lost: int
    refused: int
    doubted: int


@dataclass(frozen=True)
class StreamOutcome:
    """What came of a stream.

    Attributes
    ----------
    first, last
        Labels of its states; empty where there is none.
    cameras
        By name.
    broke_off
        Whether it ended before its end: what had come into the spool is there.
    rate_hz
        At which moments became whole, from the first state to the last; None for fewer than two.
    channels
        The least and the greatest value that its states have of each channel, by name.
    unread
        States of which a channel has no value, by its name.
    """

    first: str = ""
    last: str = ""
    cameras: Mapping[str, StreamedCamera] = field(default_factory=dict)
    broke_off: bool = False
    rate_hz: float | None = None
    channels: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    unread: Mapping[str, int] = field(default_factory=dict)
