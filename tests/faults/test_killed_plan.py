"""A plan of recordings outlives its service: each state is recorded once, and no frame is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.deployments import mainly

from sms_jobs.bench.recorded.killed_plan import Day, KilledPlan


@pytest.fixture(params=mainly("grown"))
def environment(request: pytest.FixtureRequest) -> dict[str, str]:
    """Settings of either deployment, of which `test_kills` kills the services of both."""
    if request.param == "embedded":
        return {}
    return {
        "SMS_DATABASE_URL": request.getfixturevalue("fresh_postgresql_url"),
        "SMS_BROKER_URL": request.getfixturevalue("redis_url"),
    }


def killed(home: Path, environment: dict[str, str], states: int, kills: int) -> Day:
    home.mkdir(exist_ok=True)
    plan = KilledPlan(home, environment, states, np.random.default_rng(states))
    day = plan.run(kills, lambda said: print(said, flush=True))
    print(f"\n{day}")
    assert (day.once, day.doubted, day.lost) == (states, 0, 0)
    return day


def test_a_plan_goes_on_after_each_kill(home: Path, environment: dict[str, str]) -> None:
    assert killed(home, environment, states=2, kills=2).kills == 2


@pytest.mark.long
def test_ten_states_under_many_kills(home: Path, environment: dict[str, str]) -> None:
    day = killed(home, environment, states=10, kills=20)
    # Kills that meet no recording would show little.
    assert (day.kills, day.resumed >= 5) == (20, True)
