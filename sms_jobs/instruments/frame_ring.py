"""Frames of one camera that wait in memory: for an event, and then for the disk.

All of its memory is taken when it is made, and nothing is ever added: what has no room is told.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from threading import Condition
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Held:
    """A frame that waits.

    Attributes
    ----------
    place
        Of its image in the ring.
    number, time_s
        As the camera counts it, and when it was exposed by the clock of the rig.
    """

    place: int
    number: int
    time_s: float


class FrameRing:
    """Takes frames from one thread and gives them, in order, to another.

    Until it flows it keeps the newest, and each frame takes the place of the oldest; from then on it gives
    away all that it has, and takes a frame only where there is room.

    Parameters
    ----------
    frames
        How many it holds.
    rows, columns, dtype
        Of an image.
    """

    def __init__(self, frames: int, rows: int, columns: int, dtype: str) -> None:
        self._images = np.empty((frames, rows, columns), dtype)
        self._images.fill(0)  # so that the memory is there before the first frame
        self._free = deque(range(frames))
        self._waiting: deque[Held] = deque()
        self._changed = Condition()
        self._flows = self._closed = False

    def put(self, number: int, time_s: float, image: NDArray[Any]) -> bool:
        """Take a frame; return False when it flows and the disk has left no room for one more."""
        with self._changed:
            if self._free:
                place = self._free.popleft()
            elif self._flows or not self._waiting:
                return False
            else:
                place = self._waiting.popleft().place
        self._images[place] = image
        with self._changed:
            self._waiting.append(Held(place, number, time_s))
            self._changed.notify_all()
        return True

    def flow(self, since_s: float) -> None:
        """Give away, from now on, all frames that were exposed since a time; those before are let go."""
        with self._changed:
            while self._waiting and self._waiting[0].time_s < since_s:
                self._free.append(self._waiting.popleft().place)
            self._flows = True
            self._changed.notify_all()

    def close(self) -> None:
        """Take no more: what flows is still given away, and then there is nothing."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def take(self) -> Held | None:
        """Return the oldest frame once it flows, to be let go after use; None when nothing more comes."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or (self._flows and self._waiting))
            return self._waiting.popleft() if self._flows and self._waiting else None

    def image(self, held: Held) -> NDArray[Any]:
        """Return the image of a frame that was taken, (rows, columns)."""
        image: NDArray[Any] = self._images[held.place]
        return image

    def let_go(self, held: Held) -> None:
        """Give the place of a frame back."""
        with self._changed:
            self._free.append(held.place)
