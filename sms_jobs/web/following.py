"""Follows what happens: one thread asks the catalogue for all who listen.

Changes of jobs and other changes have numbers of their own. Rows are numbered before they are committed, so
that on PostgreSQL one may become visible after another with a higher number. Numbers that are left out are
looked for again for some minutes, and a listener that comes back goes on before the first of them: it may be
told something twice, and misses nothing.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import TypeAlias

from sms_jobs.app.work import happenings
from sms_jobs.app.work.happenings import Cursor, Happening, News
from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.records.shown.changes import Change

Told: TypeAlias = tuple[Cursor, Happening | Change]
"""What happened, and where to go on after it."""

_log = logging.getLogger(__name__)

EVERY_S = 0.1
"""Half of it is what an event waits in the mean; asking takes about 1 % of that."""
GIVEN_UP_AFTER_S = 180.0
"""A number that nobody has committed by then was of a transaction that was rolled back."""
_MOST_MISSING = 20_000
_MOST_RANGES = 100
_LOOKED_BACK = 1000
_MOST_WAITING = 2000
_ENDS_WITHIN_S = 5.0


class Order:
    """Which numbers were seen, and which are missing among them.

    Parameters
    ----------
    newest
        Number up to which nothing is expected any more.
    """

    def __init__(self, newest: int) -> None:
        self.newest = newest
        self._missing: dict[int, float] = {}

    @property
    def safe(self) -> int:
        """The highest number up to which nothing is missing."""
        return min(self._missing, default=self.newest + 1) - 1

    def ranges(self) -> list[tuple[int, int]]:
        """Return what is missing: first and last of each range."""
        numbers = sorted(self._missing)
        runs = (list(run) for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]))
        return [(run[0][1], run[-1][1]) for run in runs][:_MOST_RANGES]

    def enter(self, numbers: Iterable[int], now: float) -> None:
        """Note numbers that were seen, in rising order, and give up what has been missing for long."""
        for number in numbers:
            self._missing.pop(number, None)
            left_out = range(max(self.newest + 1, number - _MOST_MISSING), number)
            self._missing.update(dict.fromkeys(left_out, now))
            self.newest = max(self.newest, number)
        if self._missing:
            kept = list(self._missing.items())[-_MOST_MISSING:]
            self._missing = {n: since for n, since in kept if now - since < GIVEN_UP_AFTER_S}


class Listener:
    """Somebody who is told what happens; for one task of an event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._told: deque[Told] = deque()
        self._ring = asyncio.Event()
        self.dropped = False
        """Whether this listener is told nothing more: so much waited for it, or the server ends."""

    def tell(self, told: Sequence[Told]) -> None:
        """Take what happened, each with where to go on after it; from any thread."""
        if self.dropped or len(self._told) + len(told) > _MOST_WAITING:
            self.dropped = True
        else:
            self._told.extend(told)
        self._wake()

    def dismiss(self) -> None:
        """Take nothing more, and wait for nothing; from any thread."""
        self.dropped = True
        self._wake()

    def _wake(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self._ring.set)
        except RuntimeError:  # the loop has ended
            self.dropped = True

    async def next(self, timeout_s: float) -> list[Told]:
        """Return what happened since, once something has; nothing after so many seconds."""
        try:
            await asyncio.wait_for(self._ring.wait(), timeout_s)
        except TimeoutError:
            return []
        self._ring.clear()
        return [self._told.popleft() for _ in range(len(self._told))]


class _Orders:
    """Which numbers were seen of changes of jobs, and which of other changes."""

    def __init__(self, newest: Cursor) -> None:
        self.jobs, self.changes = Order(newest.jobs), Order(newest.changes)

    @property
    def newest(self) -> Cursor:
        """The highest numbers that were seen."""
        return Cursor(self.jobs.newest, self.changes.newest)

    @property
    def safe(self) -> Cursor:
        """The highest numbers up to which nothing is missing."""
        return Cursor(self.jobs.safe, self.changes.safe)

    def enter(self, found: News, now: float) -> None:
        """Note what was seen, and give up what has been missing for long."""
        self.jobs.enter((one.number for one in found.jobs), now)
        self.changes.enter((one.number for one in found.changes), now)


class Follower:
    """Asks for what happened, as long as somebody listens.

    Parameters
    ----------
    services
        In whose name it asks.
    """

    def __init__(self, services: Services) -> None:
        self._services = services
        self._lock = threading.Lock()
        self._listeners: set[Listener] = set()
        self._orders: _Orders | None = None
        self._thread: threading.Thread | None = None
        self._dismissed = False

    @property
    def listeners(self) -> int:
        """How many listen now."""
        with self._lock:
            return len(self._listeners)

    def listen(self, listener: Listener) -> Cursor:
        """Tell a listener what happens from now on; return the numbers after which that is everything.

        Whoever comes after all were dismissed is dismissed, too. Asks the catalogue, and so does not belong
        into an event loop. Raises `ServerUnreachable`.
        """
        with self._lock:
            if self._dismissed:
                listener.dismiss()
                return Cursor(0, 0)
            if self._orders is None:
                self._orders = self._begun()
            self._listeners.add(listener)
            if self._thread is None:
                self._thread = threading.Thread(target=self._follow, name="follower", daemon=True)
                self._thread.start()
            return self._orders.safe

    def leave(self, listener: Listener) -> None:
        """Tell a listener nothing more."""
        with self._lock:
            self._listeners.discard(listener)

    def dismiss(self) -> None:
        """Tell nobody anything more, and everybody so."""
        with self._lock:
            self._dismissed = True
            for listener in self._listeners:
                listener.dismiss()
            self._listeners.clear()

    def end(self) -> None:
        """Dismiss everybody, and return once nothing is asked for, or after some seconds.

        Whoever closes the catalogue does this before: what is asked for then would keep its connection.
        """
        self.dismiss()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join(_ENDS_WITHIN_S)

    def _begun(self) -> _Orders:
        """Return orders that know what is missing among the newest numbers."""
        newest = happenings.newest(self._services)
        orders = _Orders(Cursor(*(max(0, number - _LOOKED_BACK) for number in newest)))
        while orders.jobs.newest < newest.jobs or orders.changes.newest < newest.changes:
            found = happenings.happened(self._services, orders.newest)
            if not any(found):
                break
            orders.enter(found, time.monotonic())
        return orders

    def _follow(self) -> None:
        while True:
            began = time.monotonic()
            try:
                full = self._ask()
            except SmsError as error:
                _log.warning("what happens cannot be asked for: %s", error)
                full = False
            if full is None:
                return
            taken = time.monotonic() - began
            time.sleep(0.0 if full else max(EVERY_S, 2 * taken))

    def _ask(self) -> bool | None:
        """Tell everybody what happened, and return whether there is more; None once nobody listens."""
        with self._lock:
            if not self._listeners or self._orders is None:
                self._orders = self._thread = None
                return None
            orders = self._orders
            newest, missing = orders.newest, (orders.jobs.ranges(), orders.changes.ranges())
        found = happenings.happened(self._services, newest, missing)
        with self._lock:
            before = orders.safe
            orders.enter(found, time.monotonic())
            told = found.placed(before, orders.safe)
            for listener in self._listeners if told else ():
                listener.tell(told)
        return happenings.is_full(found)
