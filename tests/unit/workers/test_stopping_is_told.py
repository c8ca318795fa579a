"""Who stops the service is told what it waits for."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from sqlalchemy import update
from support.homes import initialised
from support.jobs import NOW, claim, submit_pipeline

from sms_jobs import bootstrap
from sms_jobs.app.home.service import supervisor
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.running import recovery


def test_a_service_that_stops_says_which_jobs_it_waits_for(
    home: Path, caplog: pytest.LogCaptureFixture
) -> None:
    initialised(home)
    with bootstrap.services(home) as services, caplog.at_level(logging.INFO):
        made = supervisor(services)
        made.worker_id = "w1"
        with services.catalogue.writing() as session:
            recovery.register_worker(session, "w1", "here", 1, ["cpu"], 1, NOW)
        submit_pipeline(services.catalogue)
        made._claim_nothing()
        assert "waiting" not in caplog.text
        with services.catalogue.writing() as session:
            session.execute(update(WorkerRow).values(draining=False))
        assert claim(services.catalogue) is not None
        made._claim_nothing()
    assert "stopping: waiting for 1 running job to end, for at most 10 min; Ctrl-C again kills" in caplog.text
