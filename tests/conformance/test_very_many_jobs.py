"""200,000 jobs that have not ended, asked about and cancelled by commands; on both deployments."""

from __future__ import annotations

import pytest
from support.command import answer, sms
from support.deployments import Deployment
from support.jobs import NOW

from sms_jobs import bootstrap
from sms_jobs.bench.large.many_jobs import CAMPAIGN, fill_queue, name_of
from sms_jobs.jobs.asking import inquiry

ACTIVE = 200_000
"""Thrice as many as PostgreSQL takes values in a statement."""


@pytest.mark.long
def test_commands_answer_rightly_about_very_many_jobs(deployment: Deployment) -> None:
    environment, home = deployment.environment, ("--home", str(deployment.home))
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        bootstrap.initialise(deployment.home)
    catalogue = deployment.catalogue()
    fill_queue(catalogue, ACTIVE, NOW)

    status = answer("status", *home, environment=environment)
    assert status["jobs"]["queued"] == ACTIVE // 4
    assert status["jobs"]["waiting"] == ACTIVE * 3 // 4
    assert status["outlook"]["estimate"]["jobs"] == ACTIVE

    listed = sms("job", "list", "-c", name_of(0), "--limit", "3", *home, environment=environment)
    assert listed.returncode == 0
    assert f"{CAMPAIGN} jobs of {name_of(0)} have not ended" in listed.stderr

    waited = sms("job", "wait", "--timeout", "0", *home, environment=environment)
    assert waited.returncode == 124
    assert f"{ACTIVE} of {ACTIVE} jobs have not ended" in waited.stderr

    cancelled = sms("job", "cancel", "-c", name_of(1), *home, environment=environment)
    assert cancelled.stderr.strip() == f"cancelled {CAMPAIGN} jobs"
    with catalogue.reading() as session:
        assert inquiry.counts(session)["cancelled"] == CAMPAIGN
    catalogue.close()
