"""What the planner watches a channel for: the load or count of a planned recording, or the next level."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy.orm import Session

from sms_jobs.bootstrap import Services
from sms_jobs.instruments.holding import Detector, Hold, HoldDetector, StandstillDetector
from sms_jobs.instruments.level_detector import LevelDetector
from sms_jobs.jobs.recording import due_recordings, planned_levels, reached_levels, watched_rigs
from sms_jobs.jobs.recording.due_recordings import Due
from sms_jobs.jobs.recording.reached_levels import DueLevels
from sms_jobs.records.triggers import Holding, Watched


class Awaited(ABC):
    """Something that is there once a channel of a rig has read certain values."""

    due: Due | DueLevels
    """What is planned."""

    @property
    def campaign(self) -> str:
        """Of whose plan it is."""
        return self.due.campaign

    @property
    def rig(self) -> str:
        """Whose channel is read."""
        return self.due.rig

    @property
    def known_note(self) -> str | None:
        """What is known to keep the channel from being watched."""
        return self.due.note

    @property
    @abstractmethod
    def channel(self) -> str:
        """Which channel is read."""

    @property
    @abstractmethod
    def about(self) -> str:
        """What begins then, for the log."""

    @property
    @abstractmethod
    def key(self) -> tuple[object, ...]:
        """By which it is known: with another one, what was read so far does not count."""

    @abstractmethod
    def detector(self) -> Detector:
        """Return what says of readings that it is there."""

    @abstractmethod
    def rehearse(self, services: Services, now: datetime) -> None:
        """Raise what would keep it from beginning."""

    @abstractmethod
    def begin(self, services: Services, seen: float | None, now: datetime, holder: str) -> str | None:
        """Begin, and return what is to be told of that; None where it is not to begin any more.

        Parameters
        ----------
        seen
            What the channel read just now, in its unit.
        holder
            That holds the rig and gives it back.
        """

    @abstractmethod
    def note(self, session: Session, words: str) -> None:
        """Note what keeps it from being watched, or from beginning."""

    @abstractmethod
    def note_reading(self, session: Session, seen: float | None, now: datetime) -> None:
        """Note what the channel read, and that nothing keeps it from that."""


@dataclass(frozen=True)
class AwaitedRecording(Awaited):
    """A planned recording that waits for a channel."""

    due: Due
    trigger: Watched

    @property
    def channel(self) -> str:
        """Which channel that is."""
        return self.trigger.channel

    @property
    def about(self) -> str:
        """The state that is recorded."""
        return f"{self.due.campaign}/{self.due.label}"

    @property
    def key(self) -> tuple[object, ...]:
        """Row and revision of the plan."""
        return self.due.row_id, self.due.revision

    def detector(self) -> Detector:
        """Return what says that the load is held, or the count reached."""
        trigger = self.trigger
        if isinstance(trigger, Holding):
            return HoldDetector(Hold(trigger.target, trigger.tolerance, trigger.for_s))
        return StandstillDetector(trigger.count, trigger.for_s)

    def rehearse(self, services: Services, now: datetime) -> None:
        """Raise what `due_recordings.begin` would."""
        due_recordings.rehearse(services.catalogue, self.due, now)

    def begin(self, services: Services, seen: float | None, now: datetime, holder: str) -> str | None:
        """Begin the recording."""
        job = due_recordings.begin(services.catalogue, self.due, now, now, holder)
        return None if job is None else f"{self.about} begins as job {job}: {self.trigger}"

    def note(self, session: Session, words: str) -> None:
        """Note it in the row of the recording."""
        watched_rigs.note(session, self.due.row_id, words)

    def note_reading(self, session: Session, seen: float | None, now: datetime) -> None:
        """Note it in the row of the recording."""
        watched_rigs.note_reading(session, self.due.row_id, seen, now)


@dataclass(frozen=True)
class AwaitedLevel(Awaited):
    """The next level of a stepped test, whichever it is."""

    due: DueLevels

    @property
    def channel(self) -> str:
        """Which channel that is."""
        return self.due.levels.channel

    @property
    def about(self) -> str:
        """The campaign: its next state is none yet."""
        return self.due.campaign

    @property
    def key(self) -> tuple[object, ...]:
        """Levels and revision of the plan, and the level that does not count."""
        return self.due.levels, self.due.revision, self.due.last

    def detector(self) -> Detector:
        """Return what says that another level is held."""
        return LevelDetector(self.due.levels, self.due.last)

    def rehearse(self, services: Services, now: datetime) -> None:
        """Raise what `reached_levels.add` would of the jobs."""
        reached_levels.rehearse(services.catalogue, self.due, now)

    def begin(self, services: Services, seen: float | None, now: datetime, holder: str) -> str | None:
        """Add a state at the level of a reading, and begin its recording."""
        level = None if seen is None else self.due.levels.near(seen)
        if level is None:
            return None
        added = reached_levels.add(services.catalogue, services.archive, self.due, level, now, holder)
        if added is None:
            return None
        said = self.due.levels.at(level)
        return f"{self.due.campaign} is given {added.label}, which begins as job {added.job_id}: {said}"

    def note(self, session: Session, words: str) -> None:
        """Note it in the row of the levels."""
        planned_levels.note(session, self.due.campaign_id, words)

    def note_reading(self, session: Session, seen: float | None, now: datetime) -> None:
        """Note it in the row of the levels."""
        planned_levels.note_reading(session, self.due.campaign_id, seen, now)
