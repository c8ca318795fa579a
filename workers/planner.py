"""Begins planned recordings when it is their time, and watches the channels that they wait for.

Several supervisors may do so at once: a channel is watched by the one that holds its rig, and a recording
belongs to whoever begins it first.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial

from sqlalchemy.orm import Session

from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.instruments.connection import channel_reader
from sms_jobs.instruments.holding import Detector
from sms_jobs.jobs.recording import due_recordings, quick_looks, reached_levels, watched_rigs
from sms_jobs.jobs.recording.due_recordings import Due
from sms_jobs.kinds.kind import rig_queue
from sms_jobs.records.triggers import Every, InTurn
from sms_jobs.workers.awaited import Awaited, AwaitedLevel, AwaitedRecording

logger = logging.getLogger(__name__)

_READ_EVERY_S = 0.2
_LOOK_EVERY_S = 1.0
_RENEW_EVERY_S = 3.0
_LATE_S = 4.0
_CONNECT_AGAIN_S = 5.0
_HELD_FOR = timedelta(seconds=12)
"""A rig whose watcher was killed is free again after it; longer than an instrument keeps silent at most."""
_LONGEST_GAP_S = 5.0
"""Between two readings; what was between them is not known, and what stayed before does not count."""


@dataclass
class Watch:
    """A channel that is read until what a plan waits for has come.

    Attributes
    ----------
    awaited
        What is waited for.
    holder
        The name under which the rig is held meanwhile.
    read
        Gives what the channel reads; None while it is not connected.
    connect_at, renew_at
        When to connect it, and to say again that the rig is held, by the monotonic clock, in s.
    seen
        Its last reading.
    """

    awaited: Awaited
    holder: str
    opened: ExitStack = field(default_factory=ExitStack)
    read: Callable[[], float] | None = None
    connect_at: float = 0.0
    renew_at: float = 0.0
    seen: float | None = None
    _detector: Detector | None = None
    _read_at: float = 0.0

    def held(self, moment: float) -> bool:
        """Read the channel, and return whether what is waited for is there; False while it is not connected.

        Raises `InstrumentError` where the channel does not answer; it has to be connected again then.
        """
        if self.read is None:
            return False
        self.seen = self.read()
        if self._detector is None or moment - self._read_at > _LONGEST_GAP_S:
            self._detector = self.awaited.detector()
        self._read_at = moment
        return self._detector.held(moment, self.seen)

    def close(self) -> None:
        """Let go of the channel; what it read before does not count any more."""
        self.read, self._detector = None, None
        self.opened.close()


class Planner:
    """Carries out the plans of recordings in a thread of its own.

    Parameters
    ----------
    services
        Of the home.
    worker_id
        Of the supervisor, by which it holds rigs.
    served
        Returns the queues that it serves now.
    """

    def __init__(self, services: Services, worker_id: str, served: Callable[[], Sequence[str]]) -> None:
        self._services = services
        self._worker_id = worker_id
        self._served = served
        self._watches: dict[str, Watch] = {}

    def run(self, stop_asked: threading.Event) -> None:
        """Watch until asked to stop, then let all rigs go; outlive a database that is away."""
        look_at = 0.0
        while not stop_asked.wait(_READ_EVERY_S):
            try:
                if time.monotonic() >= look_at:
                    look_at = time.monotonic() + _LOOK_EVERY_S
                    self.look(datetime.now(UTC))
                self.read()
            except SmsError as error:
                logger.warning("%s", error)
            except Exception:
                # Without this thread nothing that is planned would be recorded any more.
                logger.exception("the plans of recordings could not be carried out; trying again")
        for rig in list(self._watches):
            with suppress(SmsError):
                self._let_go(rig)

    def look(self, now: datetime) -> None:
        """Note what is recorded, begin what is due, and see which channels are to be watched."""
        due_recordings.settle(self._services.catalogue)
        quick_looks.judge(self._services.catalogue, now)
        watched: dict[str, Watch] = {}
        for one in self._waiting(now):
            if one.rig in watched:
                self._note(
                    one, f"the plan of {watched[one.rig].awaited.campaign} watches rig {one.rig} first"
                )
            elif rig_queue(one.rig) in self._served():
                watched[one.rig] = Watch(one, f"the plan of {one.campaign}, worker {self._worker_id}")
        for rig in list(self._watches):
            if rig not in watched or watched[rig].awaited.key != self._watches[rig].awaited.key:
                self._let_go(rig)
        for rig, watch in watched.items():
            kept = self._watches.get(rig, watch)
            kept.awaited = watch.awaited
            self._keep(rig, kept, now)

    def _waiting(self, now: datetime) -> Iterator[Awaited]:
        """Begin what is due, and yield what waits for a channel: levels, which have no end, come last."""
        with self._services.catalogue.reading() as session:
            following, levels = due_recordings.due(session), reached_levels.due(session)
        for one in following:
            trigger = one.trigger
            if isinstance(trigger, InTurn):
                self._begin_due(one, now)
            elif isinstance(trigger, Every):
                if (at := trigger.due(one.before, now)) is not None:
                    self._begin_due(one, at)
            else:
                yield AwaitedRecording(one, trigger)
        yield from map(AwaitedLevel, levels)

    def read(self) -> None:
        """Read every channel that is watched, and begin what has waited for it."""
        for rig, watch in list(self._watches.items()):
            moment = time.monotonic()
            if moment > watch.renew_at + _LATE_S:
                # Nobody was told that the rig is still held: another may have taken it.
                watch.close()
            try:
                held = watch.held(moment)
            except SmsError as error:
                self._lost(watch, error)
                continue
            if held:
                # The recording uses the same line; the rig is held until it is entered.
                watch.close()
                now = datetime.now(UTC)
                if self._begin(watch.awaited, watch.seen, now, watch.holder):
                    del self._watches[rig]

    def _keep(self, rig: str, watch: Watch, now: datetime) -> None:
        """Hold the rig of a watch, new or old, and connect its channel; who waits for the rig comes first."""
        catalogue, moment = self._services.catalogue, time.monotonic()
        with catalogue.reading() as session:
            ahead = watched_rigs.comes_first(session, rig, now, watch.holder)
        if ahead is not None:
            self._let_go(rig)
            self._note(watch.awaited, ahead)
            return
        if rig not in self._watches and not self._could_begin(watch.awaited, now):
            return
        if moment >= watch.renew_at:
            with catalogue.writing() as session:
                watched_rigs.hold(session, rig, watch.holder, now, _HELD_FOR)
                if watch.read is not None:
                    watch.awaited.note_reading(session, watch.seen, now)
            self._watches[rig] = watch
            watch.renew_at = moment + _RENEW_EVERY_S
        if watch.read is None and moment >= watch.connect_at:
            try:
                described = self._services.stations.rig(rig)
                watch.read = watch.opened.enter_context(channel_reader(described, watch.awaited.channel))
            except SmsError as error:
                self._lost(watch, error)

    def _lost(self, watch: Watch, error: SmsError) -> None:
        watch.close()
        watch.connect_at = time.monotonic() + _CONNECT_AGAIN_S
        self._note(watch.awaited, str(error))

    def _let_go(self, rig: str) -> None:
        watch = self._watches.pop(rig, None)
        if watch is not None:
            watch.close()
            with self._services.catalogue.writing() as session:
                watched_rigs.let_go(session, watch.holder)

    def _begin_due(self, one: Due, due_at: datetime) -> None:
        """Begin a recording that waits for no channel, if it can begin and still is to."""
        try:
            job = due_recordings.begin(self._services.catalogue, one, due_at, datetime.now(UTC))
        except SmsError as error:
            if error.retryable:
                raise
            self._tell(f"{one.campaign}/{one.label}", one.note, str(error), partial(_note_due, one))
        else:
            if job is not None:
                logger.info("%s/%s begins as job %s: %s", one.campaign, one.label, job, one.trigger)

    def _begin(self, one: Awaited, seen: float | None, now: datetime, holder: str) -> bool:
        """Begin what was waited for; False where it cannot begin, or is not to any more."""
        try:
            said = one.begin(self._services, seen, now, holder)
        except SmsError as error:
            if error.retryable:
                raise
            self._note(one, str(error))
            return False
        if said is not None:
            logger.info("%s", said)
        return said is not None

    def _could_begin(self, one: Awaited, now: datetime) -> bool:
        """Say whether it could begin now: what is wrong is told before the load has come."""
        try:
            one.rehearse(self._services, now)
        except SmsError as error:
            self._note(one, str(error))
            return False
        return True

    def _note(self, one: Awaited, words: str) -> None:
        self._tell(one.about, one.known_note, words, one.note)

    def _tell(self, about: str, known: str | None, words: str, note: Callable[[Session, str], None]) -> None:
        """Log and note what keeps something from being watched, or from beginning, unless that is known."""
        if known != words:
            logger.warning("%s: %s", about, words)
            with self._services.catalogue.writing() as session:
                note(session, words)


def _note_due(one: Due, session: Session, words: str) -> None:
    watched_rigs.note(session, one.row_id, words)
