"""What a job says when all is done is what remains to be read of it; on both deployments."""

from __future__ import annotations

import re

import pytest
from support import remembered
from support.archives import Clock, registered, run_jobs

from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.models import JobRow
from sms_jobs.jobs.planning.graph import Request


def test_a_job_keeps_its_closing_words(
    catalogue: Catalogue, archive: Archive, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remembered, "_made", {})  # so that it is computed, and says so
    registered(catalogue, archive, clock)
    (job_id, *_) = run_jobs(catalogue, archive, clock, [Request("simulate")])
    with catalogue.reading() as session:
        message = session.get_one(JobRow, job_id).message
    assert re.fullmatch(r"took \d+\.\d s; recorded 1 view", message)
