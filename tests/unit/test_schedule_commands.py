"""`sms schedule`: what is shown is as a person would write it."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from support.command import answer, inside
from support.homes import WHEN, make_home

from sms_jobs import bootstrap
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow


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
