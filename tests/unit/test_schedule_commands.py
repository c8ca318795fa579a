"""`sms schedule`: what is shown is as a person would write it."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

import pytest
from support.command import answer, inside
from support.homes import WHEN, make_home

from sms_jobs import bootstrap
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow
from sms_jobs.errors import InvalidInput


def test_an_outcome_names_options(home: Path) -> None:
    make_home(home, {})
    at = ("--home", str(home))
    assert (
        inside("schedule", "add", "nightly", "simulate", "-c", "plate", "--every", "1h", *at).returncode == 0
    )
    outcome = "failed: there is no scale; or set `alone` to look at the shape alone"
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        session.add(ScheduleFireRow(schedule_id=1, fire_time=WHEN + timedelta(hours=1), outcome=outcome))
    shown = inside("schedule", "list", *at).stdout
    assert "or set --alone to look" in shown
    assert "`" not in shown
    assert answer("schedule", "list", *at)[0]["last_outcome"] == outcome


@pytest.mark.parametrize("expression", ["0 2 * * * *", "0 0 2 * * *", "* * * * * *"])
def test_an_expression_with_seconds_is_refused(home: Path, expression: str) -> None:
    make_home(home, {})
    at = ("--home", str(home))
    refused = inside("schedule", "add", "nightly", "simulate", "-c", "plate", "--cron", expression, *at)
    assert refused.returncode == InvalidInput.exit_code
    assert f"'{expression}' has more than the 5 fields" in refused.stderr
    assert answer("schedule", "list", *at) == []


def test_a_schedule_without_times_of_its_own_says_so(home: Path) -> None:
    make_home(home, {})
    at = ("--home", str(home))
    assert (
        inside("schedule", "add", "then", "simulate", "-c", "plate", "--after", "plate", *at).returncode == 0
    )
    assert inside("schedule", "add", "held", "simulate", "-c", "plate", "--every", "1h", *at).returncode == 0
    assert len(inside("schedule", "next", "held", *at).stdout.splitlines()) == 5
    assert inside("schedule", "pause", "held", *at).returncode == 0
    for name in ("then", "held"):
        said = inside("schedule", "next", name, *at)
        assert (said.returncode, said.stdout) == (0, "")
        assert (
            said.stderr
            == f"schedule {name} has no time to come that is known; 'sms schedule list' shows it\n"
        )
