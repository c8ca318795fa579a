"""`sms schedule`: what is shown is as a person would write it."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from support.command import answer, inside
from support.homes import WHEN, initialised, make_home, stored

from sms_jobs import bootstrap
from sms_jobs.catalogue.tables.schedules import ScheduleFireRow
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.fields import Surface
from sms_jobs.virtual_rig.campaigns import small_plate


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


def test_a_gauge_that_an_image_without_scale_cannot_read_either_is_refused(home: Path) -> None:
    """Beside a surface that it lies off, a camera alone reads it where its plane was made with a scale."""
    initialised(home)
    y, x = np.mgrid[-20.0:20.0, -20.0:20.0]
    valid = np.zeros(x.shape, dtype=np.uint32)
    seen = Surface("C1P1", "mm", np.stack([x, y, 0.0 * x]), valid)
    image = Surface("C2", "px", np.stack([x, y]), valid)
    alone = replace(small_plate("plate")[1], views=("C1P1", "C2"), scene=None)
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, alone, None, datetime.now(UTC))
        stored(services, "reconstruct", "plate/S00/C1P1", {"surface": seen}, 1)

    def added(name: str, gauge: str, *options: str) -> str:
        words = ("schedule", "add", name, "gauges", "-c", "plate", "--every", "1h", "--set", f"gauge={gauge}")
        return inside(*words, *options, "--home", str(home)).stderr

    far, near = "G x=500 y=0 length=10", "G x=0 y=0 length=10"
    assert "schedule before fires next" in added("before", far)
    with bootstrap.services(home) as services:
        stored(services, "plane", "plate/S00/C2", {"surface": image}, 2)
    assert "gauge G lies off the surface of C1P1: from its middle at x=500" in added("far", far)
    assert "gauge G is in mm, which mean nothing in the image of C2" in added("c2", near, "--view", "C2")
    assert "schedule near fires next" in added("near", near)
    with bootstrap.services(home) as services:
        scaled = replace(image, unit="mm", position=25.0 * np.asarray(image.position), mm_per_px=25.0)
        stored(services, "plane", "plate/S00/C2", {"surface": scaled}, 3)
    assert "schedule far fires next" in added("far", far)


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
