"""What the Python interface asks, and how a home of this machine answers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol

from sms_jobs import bootstrap
from sms_jobs.app.holdings import finding, reading
from sms_jobs.app.holdings.finding_states import find_states
from sms_jobs.app.holdings.reading import StoredRecord
from sms_jobs.app.measuring import planned_recordings
from sms_jobs.app.measuring.plan_wishes import PlanWish
from sms_jobs.app.specimens import campaigns, specimen_frames
from sms_jobs.app.specimens.frame_choice import Choice
from sms_jobs.app.specimens.specimen_frames import FrameOf
from sms_jobs.app.work import jobs, new_jobs, run_comparison, waiting
from sms_jobs.app.work.jobs import Explanation
from sms_jobs.app.work.new_jobs import Submitted, Work
from sms_jobs.app.work.waiting import Waited
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.shown.files import Page
from sms_jobs.records.shown.planned_recordings import Dropped, PlannedRecording
from sms_jobs.records.shown.portion import Portion
from sms_jobs.records.shown.runs import RunComparison
from sms_jobs.records.shown.states import StatePage


class Source(Protocol):
    """The use cases of the Python interface, wherever they run; they raise what the use cases do."""

    @property
    def name(self) -> str:
        """What it is, for people."""

    def find(self, query: str, columns: Sequence[str] | None, limit: int) -> Iterable[Page]:
        """Yield the files that meet a query, page by page; at least one page."""

    def states(self, query: str, columns: Sequence[str] | None, limit: int) -> Iterable[StatePage]:
        """Yield the states that meet a query, page by page; at least one page."""

    def newest(self, subject: str, what: str) -> StoredRecord:
        """Return the newest record of a name, or of a kind, about a subject."""

    def of_file(self, key: str, name: str | None) -> StoredRecord:
        """Return a record of a file."""

    def definition(self, campaign: str) -> Campaign:
        """Return a campaign as it is defined."""

    def add_view(self, campaign: str, view: str) -> tuple[str, ...]:
        """Let a campaign be measured by one more view; return the states that it has not seen."""

    def frame(self, campaign: str) -> FrameOf:
        """Return the specimen frame of a campaign."""

    def find_frame(self, campaign: str, choice: Choice) -> FrameOf:
        """Find the specimen frame of a campaign."""

    def drop_frame(self, campaign: str) -> FrameOf:
        """Take the specimen frame of a campaign away."""

    def submit(self, work: Work, dry_run: bool) -> Submitted:
        """Submit jobs."""

    def compare_runs(self, before: str, after: str) -> RunComparison:
        """Return what differs between two runs."""

    def plan_recordings(self, campaign: str, wish: PlanWish) -> list[PlannedRecording]:
        """Plan recordings; return the whole plan."""

    def planned_recordings(self, campaign: str | None) -> list[PlannedRecording]:
        """Return the plan of a campaign, or all with something left."""

    def hold_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Hold planned recordings back; return which."""

    def release_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Let recordings that were held back go on; return which."""

    def skip_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Leave planned recordings out; return which."""

    def move_recording(self, campaign: str, state: str, before: str | None) -> None:
        """Let a planned recording come before another one, or last."""

    def drop_recordings(self, campaign: str, states: Sequence[str]) -> Dropped:
        """Forget planned recordings."""

    def wait(self, job: Submitted | str, timeout_s: float | None) -> Waited:
        """Return how jobs ended, once all have."""

    def explain(self, job: str) -> Explanation:
        """Say why a job stands where it does."""

    def close(self) -> None:
        """Let go what is open."""


class Home:
    """A home of this machine.

    Parameters
    ----------
    home
        Its folder; the usual one if it is None.

    Raises
    ------
    ConfigurationError
        There is no home, or its catalogue is older than this version needs.
    """

    def __init__(self, home: str | os.PathLike[str] | None) -> None:
        self._stack = ExitStack()
        path = None if home is None else Path(home)
        self._services = self._stack.enter_context(bootstrap.services(path, "python"))

    @property
    def name(self) -> str:
        """What it is, for people."""
        return f"home {self._services.settings.home}"

    def find(self, query: str, columns: Sequence[str] | None, limit: int) -> Iterable[Page]:
        """Yield the files that meet a query, page by page; at least one page."""
        return finding.find(self._services, finding.question(query), Portion(columns, limit=limit))

    def states(self, query: str, columns: Sequence[str] | None, limit: int) -> Iterable[StatePage]:
        """Yield the states that meet a query, page by page; at least one page."""
        return find_states(self._services, finding.question(query), Portion(columns, limit=limit))

    def newest(self, subject: str, what: str) -> StoredRecord:
        """Return the newest record of a name, or of a kind, about a subject."""
        return reading.newest(self._services, subject, what)

    def of_file(self, key: str, name: str | None) -> StoredRecord:
        """Return a record of a file."""
        return reading.of_file(self._services, key, name)

    def definition(self, campaign: str) -> Campaign:
        """Return a campaign as it is defined."""
        return campaigns.definition(self._services, campaign)

    def add_view(self, campaign: str, view: str) -> tuple[str, ...]:
        """Let a campaign be measured by one more view; return the states that it has not seen."""
        return campaigns.add_view(self._services, campaign, view).unseen(view)

    def frame(self, campaign: str) -> FrameOf:
        """Return the specimen frame of a campaign."""
        return specimen_frames.show(self._services, campaign)

    def find_frame(self, campaign: str, choice: Choice) -> FrameOf:
        """Find the specimen frame of a campaign."""
        return specimen_frames.find(self._services, campaign, choice)

    def drop_frame(self, campaign: str) -> FrameOf:
        """Take the specimen frame of a campaign away."""
        return specimen_frames.drop(self._services, campaign)

    def submit(self, work: Work, dry_run: bool) -> Submitted:
        """Submit jobs."""
        return new_jobs.submit(self._services, work, dry_run=dry_run)

    def compare_runs(self, before: str, after: str) -> RunComparison:
        """Return what differs between two runs."""
        return run_comparison.compare_runs(self._services, before, after)

    def plan_recordings(self, campaign: str, wish: PlanWish) -> list[PlannedRecording]:
        """Plan recordings; return the whole plan."""
        return planned_recordings.plan(
            self._services,
            campaign,
            wish.when,
            wish.states,
            ask=wish.ask,
            process=wish.process,
            look=wish.looked_at,
        )

    def planned_recordings(self, campaign: str | None) -> list[PlannedRecording]:
        """Return the plan of a campaign, or all with something left."""
        return planned_recordings.show(self._services, campaign)

    def hold_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Hold planned recordings back; return which."""
        return planned_recordings.hold(self._services, campaign, states)

    def release_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Let recordings that were held back go on; return which."""
        return planned_recordings.go(self._services, campaign, states)

    def skip_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Leave planned recordings out; return which."""
        return planned_recordings.skip(self._services, campaign, states)

    def move_recording(self, campaign: str, state: str, before: str | None) -> None:
        """Let a planned recording come before another one, or last."""
        planned_recordings.move(self._services, campaign, state, before)

    def drop_recordings(self, campaign: str, states: Sequence[str]) -> Dropped:
        """Forget planned recordings."""
        return planned_recordings.drop(self._services, campaign, states)

    def wait(self, job: Submitted | str, timeout_s: float | None) -> Waited:
        """Return how jobs ended, once all have."""
        some = job.jobs if isinstance(job, Submitted) else jobs.choose(self._services, [job], None)
        return waiting.wait_for(self._services, some, timeout_s)

    def explain(self, job: str) -> Explanation:
        """Say why a job stands where it does."""
        return jobs.explain(self._services, job)

    def close(self) -> None:
        """Close the catalogue."""
        self._stack.close()
