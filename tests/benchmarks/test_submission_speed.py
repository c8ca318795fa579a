"""How long it takes to plan and submit a campaign of ten thousand jobs."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from itertools import count
from pathlib import Path

from pytest_benchmark.fixture import BenchmarkFixture

from sms_jobs import bootstrap
from sms_jobs.jobs.planning import Request
from sms_jobs.jobs.registration import register_campaign
from sms_jobs.jobs.submission import submit
from sms_jobs.virtual_rig.campaigns import top_hat_bending


def test_planning_and_submitting_ten_thousand_jobs(benchmark: BenchmarkFixture, home: Path) -> None:
    bootstrap.initialise(home)
    calibration, campaign = top_hat_bending("long-test", "small")
    deformed = tuple(replace(campaign.states[1], label=f"S{n:03d}") for n in range(1, 530))
    campaign = replace(campaign, states=(campaign.states[0], *deformed))
    numbers = count()
    with bootstrap.services(home) as services:

        def register() -> tuple[tuple[str], dict[str, object]]:
            name = f"long-test-{next(numbers)}"
            record = replace(campaign, name=name)
            register_campaign(services.catalogue, services.archive, record, calibration, datetime.now(UTC))
            return (name,), {}

        def submit_all(name: str) -> int:
            with services.catalogue.writing() as session:
                done = submit(session, name, [Request("acquire"), Request("pipeline")], datetime.now(UTC))
            return len(done.job_ids)

        assert benchmark.pedantic(submit_all, setup=register, rounds=3) > 10_000
