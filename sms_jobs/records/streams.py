"""How much a stream of frames is: in time, in memory, on disks."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import ceil

_DISK_S = 2.0
"""So long a disk may take for something else before a frame has no room in memory."""
_LEAST_FOR_DISK = 8
_LABEL = re.compile(r"t(?:(?P<stream>[1-9][0-9]{0,8})-)?[0-9]{4,}", re.ASCII)


@dataclass(frozen=True)
class StreamSize:
    """At which rate cameras are exposed, how long, and what of it is kept.

    Attributes
    ----------
    rate_hz
        Frames of each camera a second.
    for_s
        How long they are streamed; around an event, how long that is waited for.
    before_s, after_s
        What is kept before and after an event; None of both to keep all.
    """

    rate_hz: float
    for_s: float
    before_s: float | None = None
    after_s: float | None = None

    @property
    def kept_s(self) -> float:
        """How long the part is that is kept."""
        if self.before_s is None or self.after_s is None:
            return self.for_s
        return self.before_s + self.after_s

    @property
    def frames(self) -> int:
        """How many frames of each camera are kept, at most, give or take the ends around an event."""
        return max(round(self.rate_hz * self.kept_s), 1)

    @property
    def most_frames(self) -> int:
        """The same with the ends."""
        return self.frames + 2

    @property
    def ring_frames(self) -> int:
        """How many frames of each camera wait in memory: those before an event, and for the disk."""
        before = ceil(self.rate_hz * (self.before_s or 0.0))
        return before + max(ceil(self.rate_hz * _DISK_S), _LEAST_FOR_DISK)


def frame_label(stream: int, frame: int) -> str:
    """Return the label of a state that a frame of a stream is: t0001, and of the second stream t2-0001.

    Parameters
    ----------
    stream, frame
        Both from 1: the stream in its campaign, the state in its stream.
    """
    return f"t{frame:04d}" if stream == 1 else f"t{stream}-{frame:04d}"


def stream_of(label: str) -> int:
    """Return of which stream a state of that label is a frame; 0 where it is of none."""
    found = _LABEL.fullmatch(label)
    return 0 if found is None else int(found["stream"] or 1)
