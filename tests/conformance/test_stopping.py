"""A job that reaches no checkpoint is ended by force, and the service goes on."""

from __future__ import annotations

import os
import signal

import pytest
from sqlalchemy import select
from support.command import answer, inside, service, sms, wait_until
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import JOBS

from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.asking import inquiry
from sms_jobs.records.job import JobState


@pytest.mark.long  # it waits for three limits of time
def test_a_frozen_job_is_cancelled_by_force_and_the_rest_runs_on(deployment: Deployment) -> None:
    # A frozen process hears neither the flag nor SIGTERM: it stands for native code that never returns.
    environment = deployment.environment | {"SMS_STOP_GRACE_S": "0.5", "SMS_WORKERS": "1"}
    make_home(deployment.home, environment)
    home = ["--home", str(deployment.home)]
    jobs = answer("job", "submit", "simulate", "pipeline", "-c", "plate", *home, environment=environment)[
        "jobs"
    ]
    catalogue = deployment.catalogue()

    def running() -> tuple[str, int] | None:
        with catalogue.reading() as session:
            row = session.scalar(select(JobRow).where(JobRow.state == JobState.RUNNING))
            return None if row is None or row.pid is None else (row.id, row.pid)

    def freeze() -> str | None:
        found = running()
        if found is None:
            return None
        os.kill(found[1], signal.SIGSTOP)
        if running() == found:
            return found[0]
        os.kill(found[1], signal.SIGCONT)  # its job ended before it was stopped
        return None

    with service(deployment.home, environment):
        frozen = wait_until(freeze)
        # Within this process: a stopped one is woken after 3 s, and to start another may take longer.
        assert inside("job", "cancel", frozen, *home, environment=environment).returncode == 0
        sms("job", "wait", *jobs, *home, environment=environment)
    with catalogue.reading() as session:
        counted = inquiry.counts(session)
        stopped = session.get_one(JobRow, frozen)
        assert stopped.state is JobState.CANCELLED
        assert "its process was ended" in stopped.message
    catalogue.close()
    # What needs the cancelled recording is skipped; everything else has run.
    assert counted["cancelled"] == 1
    assert sum(counted.values()) == JOBS
    assert set(counted) == {"cancelled", "skipped", "succeeded"}
