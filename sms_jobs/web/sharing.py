"""What many ask for at once is found once: fifty open pages must not ask the catalogue fifty times."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")

FRESH_S = 1.0
"""What was found is given to others for so long; a page that is notified of an event asks again anyway."""
_MOST = 64


class _Slot(Generic[T]):
    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.found: tuple[float, T] | None = None


class Shared(Generic[T]):
    """Answers that are the same for everybody who may ask, found once for all who ask within a moment."""

    def __init__(self, fresh_s: float = FRESH_S) -> None:
        self._fresh_s = fresh_s
        self._lock = threading.Lock()
        self._slots: OrderedDict[Hashable, _Slot[T]] = OrderedDict()

    def of(self, key: Hashable, find: Callable[[], T]) -> T:
        """Return what `find` returned for this key a moment ago, or what it returns now.

        Who asks while somebody else is finding it waits for that; an error is that of whoever found it.
        """
        with self._lock:
            slot = self._slots.setdefault(key, _Slot())
            self._slots.move_to_end(key)
            while len(self._slots) > _MOST:
                self._slots.popitem(last=False)
        asked = time.monotonic()
        with slot.lock:
            # Begun before somebody asked, it may not show what that somebody has just changed.
            if slot.found is None or asked - slot.found[0] > self._fresh_s:
                begun = time.monotonic()
                slot.found = (begun, find())
            return slot.found[1]
