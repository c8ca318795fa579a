"""What a job says when all is done is what remains to be read of it; on both deployments."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from support import remembered
from support.archives import Clock, registered, run_jobs

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.planning.chosen import by_ids
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.running.remarks import remarks
from sms_jobs.kinds.kind import Inputs, Output, Progress
from sms_jobs.kinds.recording import simulate
from sms_jobs.records.remarks import remarked
from sms_jobs.records.shown.remarks import Remarks


def test_a_job_keeps_its_closing_words(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remembered, "_made", {})  # so that it is computed, and says so
    registered(catalogue, archive, clock)
    (job_id, *_) = run_jobs(catalogue, archive, clock, [Request("simulate")])
    with catalogue.reading() as session:
        message = session.get_one(JobRow, job_id).message
    assert re.fullmatch(r"took \d+\.\d s; recorded 1 view", message)


def test_what_jobs_remark_is_told_to_who_waits(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remembered, "_made", {})
    registered(catalogue, archive, clock)

    def run(inputs: Inputs, parameters: Any, progress: Progress) -> Iterator[Output]:
        yield from simulate.run(inputs, parameters, progress)
        progress(1.0, remarked(f"{inputs.subject.state} is 100 % dark", beside="recorded"))

    monkeypatch.setitem(vars(simulate.KIND), "run", run)
    (first, *_) = ids = run_jobs(catalogue, archive, clock, [Request("simulate")])
    with catalogue.reading() as session:
        message = session.get_one(JobRow, first).message
        assert message.endswith("; recorded; note: S00 is 100 % dark")
        (told,) = remarks(session, by_ids(ids), clock())
        assert remarks(session, by_ids([]), clock()) == ()
    assert told == Remarks("simulate", 2, tuple(f"plate/{s}: {s} is 100 % dark" for s in ("S00", "S01")))
    # It is as true of a result that is reused.
    (again, *_) = run_jobs(catalogue, archive, clock, [Request("simulate")])
    with catalogue.reading() as session:
        message = session.get_one(JobRow, again).message
    assert message == f"reused from job {first[:8]}; note: S00 is 100 % dark"
