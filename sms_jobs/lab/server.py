"""How a server answers what the Python interface asks."""

from __future__ import annotations

import io
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from sms_jobs.app.holdings import reading
from sms_jobs.app.holdings.reading import RecordParts, StoredRecord
from sms_jobs.app.measuring.plan_wishes import PlanWish
from sms_jobs.app.specimens.frame_choice import Choice
from sms_jobs.app.specimens.specimen_frames import FrameOf
from sms_jobs.app.work.jobs import Explanation
from sms_jobs.app.work.new_jobs import Refusal, Submitted, Work
from sms_jobs.app.work.waiting import Waited, timed_out
from sms_jobs.lab.connection import Connection
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.shown.estimates import Estimate
from sms_jobs.records.shown.files import FileView, Found, Page
from sms_jobs.records.shown.planned_recordings import Dropped, PlannedRecording
from sms_jobs.records.shown.remarks import Remarks
from sms_jobs.records.shown.runs import RunComparison
from sms_jobs.records.shown.states import FoundState, StatePage
from sms_jobs.records.specimen_frame import SpecimenFrame

_PAGE = 1000
_WAIT_S = 25.0
"""A server is asked again so often for jobs that are waited for."""
_AT_ONCE = 200
"""Jobs that are named in one request."""

_PLANNED = "/recordings/planned"

_CAMPAIGN = TypeAdapter(Campaign)
_FILE = TypeAdapter(FileView)
_PARTS = TypeAdapter(RecordParts)
_ESTIMATE = TypeAdapter(Estimate)
_COMPARISON = TypeAdapter(RunComparison)
_FRAME = TypeAdapter(SpecimenFrame)
_PLAN = TypeAdapter(list[PlannedRecording])
_REMARKS = TypeAdapter(list[Remarks])


class Server:
    """A home at a server.

    Parameters
    ----------
    url
        Where `sms serve` runs.
    token
        Of the person in whose name it is asked.

    Raises as `sms_jobs.connect` does.
    """

    def __init__(self, url: str, token: str | None) -> None:
        self._connection = Connection(url, token)
        try:
            self._connection.get("/session" if token is not None else "/status")
        except BaseException:
            self._connection.close()
            raise

    @property
    def name(self) -> str:
        """What it is, for people."""
        return f"server {self._connection.url}"

    def find(self, query: str, columns: Sequence[str] | None, limit: int) -> Iterator[Page]:
        """Yield the files that meet a query, page by page; at least one page."""
        for told in self._pages("/data/find", "files", query, columns, limit):
            yield _page(told)

    def states(self, query: str, columns: Sequence[str] | None, limit: int) -> Iterator[StatePage]:
        """Yield the states that meet a query, page by page; at least one page."""
        for told in self._pages("/data/states", "states", query, columns, limit):
            yield _state_page(told)

    def _pages(
        self, where: str, what: str, query: str, columns: Sequence[str] | None, limit: int
    ) -> Iterator[dict[str, Any]]:
        asked: dict[str, Any] = {"query": query}
        if columns is not None:
            asked["columns"] = ",".join(columns)
        while True:
            told = self._connection.get(where, asked | {"limit": min(limit, _PAGE)})
            yield told
            limit -= len(told[what])
            if limit <= 0 or told["next"] is None:
                return
            asked["after"] = told["next"]

    def newest(self, subject: str, what: str) -> StoredRecord:
        """Return the newest record of a name, or of a kind, about a subject."""
        found = self._connection.get("/data/newest", {"subject": subject, "what": what})
        return self.of_file(str(found["file"]["id"]), found["record"])

    def of_file(self, key: str, name: str | None) -> StoredRecord:
        """Return a record of a file."""
        asked = {} if name is None else {"name": name}
        parts = _PARTS.validate_python(self._connection.get(f"/data/{quote(key, safe='')}/record", asked))

        def read(array: str) -> NDArray[Any]:
            where = f"/data/{parts.file.id}/arrays/{quote(parts.name, safe='')}/{quote(array, safe='')}"
            values: NDArray[Any] = np.load(io.BytesIO(self._connection.get_bytes(where)), allow_pickle=False)
            return values

        return reading.assembled(parts, read)

    def definition(self, campaign: str) -> Campaign:
        """Return a campaign as it is defined."""
        told = self._connection.get(f"/campaigns/{quote(campaign, safe='')}")
        return _CAMPAIGN.validate_python(told["campaign"])

    def add_view(self, campaign: str, view: str) -> tuple[str, ...]:
        """Let a campaign be measured by one more view; return the states that it has not seen."""
        where = f"/campaigns/{quote(campaign, safe='')}/views"
        return tuple(self._connection.post(where, {"view": view})["unseen"])

    def frame(self, campaign: str) -> FrameOf:
        """Return the specimen frame of a campaign."""
        return _frame(self._connection.get(_of_frame(campaign)))

    def find_frame(self, campaign: str, choice: Choice) -> FrameOf:
        """Find the specimen frame of a campaign."""
        body = asdict(choice)
        body["fit"] = body.pop("region")
        return _frame(self._connection.post(_of_frame(campaign), body))

    def drop_frame(self, campaign: str) -> FrameOf:
        """Take the specimen frame of a campaign away."""
        return _frame(self._connection.delete(_of_frame(campaign)))

    def submit(self, work: Work, dry_run: bool) -> Submitted:
        """Submit jobs."""
        body = {
            "campaign": work.campaign,
            "kinds": work.kinds,
            "parameters": work.parameters,
            "states": work.states,
            "views": work.views,
            "priority": work.priority,
            "use_cache": work.use_cache,
            "run": work.run,
            "dry_run": dry_run,
        }
        done = self._connection.post("/jobs", body)
        refused = tuple(Refusal(**one) for one in done["refused"])
        estimate = _ESTIMATE.validate_python(done["estimate"])
        return Submitted.from_server(done["jobs"], done["counted"], estimate, refused)

    def compare_runs(self, before: str, after: str) -> RunComparison:
        """Return what differs between two runs."""
        where = f"/runs/{quote(before, safe='')}/compare"
        return _COMPARISON.validate_python(self._connection.get(where, {"with": after}))

    def plan_recordings(self, campaign: str, wish: PlanWish) -> list[PlannedRecording]:
        """Plan recordings; return the whole plan."""
        return _PLAN.validate_python(self._connection.post(_PLANNED, {"campaign": campaign} | asdict(wish)))

    def planned_recordings(self, campaign: str | None) -> list[PlannedRecording]:
        """Return the plan of a campaign, or all with something left."""
        asked = {} if campaign is None else {"campaign": campaign}
        return _PLAN.validate_python(self._connection.get(_PLANNED, asked))

    def hold_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Hold planned recordings back; return which."""
        return list(self._of_plan("hold", campaign, states)["held"])

    def release_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Let recordings that were held back go on; return which."""
        return list(self._of_plan("go", campaign, states)["going"])

    def skip_recordings(self, campaign: str, states: Sequence[str]) -> list[str]:
        """Leave planned recordings out; return which."""
        return list(self._of_plan("skip", campaign, states)["skipped"])

    def move_recording(self, campaign: str, state: str, before: str | None) -> None:
        """Let a planned recording come before another one, or last."""
        body = {"campaign": campaign, "state": state, "before": before}
        self._connection.post(f"{_PLANNED}/move", body)

    def drop_recordings(self, campaign: str, states: Sequence[str]) -> Dropped:
        """Forget planned recordings."""
        told = self._of_plan("drop", campaign, states)
        return Dropped(tuple(told["dropped"]), tuple(told["recorded"]), tuple(told["running"]))

    def _of_plan(self, action: str, campaign: str, states: Sequence[str]) -> dict[str, Any]:
        body = {"campaign": campaign, "states": list(states)}
        done: dict[str, Any] = self._connection.post(f"{_PLANNED}/{action}", body)
        return done

    def wait(self, job: Submitted | str, timeout_s: float | None) -> Waited:
        """Return how jobs ended, once all have."""
        ids = job.job_ids if isinstance(job, Submitted) else (job,)
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        counted: Counter[str] = Counter()
        active, failure = 0, ""
        told: list[Remarks] = []
        for first in range(0, len(ids), _AT_ONCE):
            looked = self._ended(ids[first : first + _AT_ONCE], deadline)
            counted.update(looked["jobs"])
            active += looked["active"]
            failure = looked["failure"] or failure
            told += _REMARKS.validate_python(looked["remarks"])
        if active and timeout_s is not None:
            raise timed_out(active, dict(counted), timeout_s)
        return Waited(dict(counted), failure, remarks=tuple(told))

    def explain(self, job: str) -> Explanation:
        """Say why a job stands where it does."""
        told = self._connection.get(f"/jobs/{quote(job, safe='')}/explain")
        return Explanation(told["job_id"], tuple(told["sentences"]))

    def close(self) -> None:
        """Close all connections."""
        self._connection.close()

    def _ended(self, ids: Sequence[str], deadline: float | None) -> dict[str, Any]:
        """Return how some jobs stand once they have ended, or nobody waits any more."""
        while True:
            left = _WAIT_S if deadline is None else min(_WAIT_S, max(deadline - time.monotonic(), 0.0))
            looked: dict[str, Any] = self._connection.get("/jobs/wait", {"job": ids, "seconds": left})
            if looked["ended"] or (deadline is not None and time.monotonic() >= deadline):
                return looked


def _of_frame(campaign: str) -> str:
    return f"/campaigns/{quote(campaign, safe='')}/frame"


def _frame(told: dict[str, Any]) -> FrameOf:
    frame = None if told["frame"] is None else _FRAME.validate_python(told["frame"])
    return FrameOf(told["campaign"], frame, told["of_scene"], told["in_image"], told["stale"])


def _page(told: dict[str, Any]) -> Page:
    found = (
        Found(_FILE.validate_python(one), _values(one["values"], told["times"])) for one in told["files"]
    )
    return Page(tuple(told["columns"]), tuple(found), told["next"])


def _state_page(told: dict[str, Any]) -> StatePage:
    found = (
        FoundState(
            one["id"],
            _values(one["values"], told["times"]),
            one["views"],
            None if one["met_by"] is None else tuple(one["met_by"]),
        )
        for one in told["states"]
    )
    return StatePage(tuple(told["columns"]), tuple(told["by_view"]), tuple(found), told["next"])


def _values(told: dict[str, Any], times: Sequence[str]) -> dict[str, Any]:
    return {
        name: datetime.fromisoformat(value) if name in times and value is not None else value
        for name, value in told.items()
    }
