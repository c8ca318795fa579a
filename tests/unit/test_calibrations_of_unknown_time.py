"""A calibration of which nobody knows the time shows none, comes last, and is still compared and used."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from support.command import answer, inside
from support.homes import make_home

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import calibration_drift
from sms_jobs.jobs.archiving.registration import register_calibration, register_campaign
from sms_jobs.records.sensors import Rig
from sms_jobs.records.shown.times import valid_from
from sms_jobs.records.times import UNTIMED
from sms_jobs.virtual_rig.campaigns import small_plate

EARLY, LATE = datetime(1999, 5, 4, tzinfo=UTC), datetime(2026, 5, 4, tzinfo=UTC)


def test_no_time_is_shown_where_none_is_known(home: Path) -> None:
    make_home(home, {})
    made, _ = small_plate("plate")
    at = ("--home", str(home))
    with bootstrap.services(home) as services:
        numbers = []
        for place, since in enumerate((LATE, UNTIMED, EARLY)):
            cameras = tuple(
                replace(s, intrinsics=replace(s.intrinsics, fx=s.intrinsics.fx + place))
                for s in made.rig.sensors
            )
            one = replace(made, rig=Rig("stand", cameras), valid_from=since)
            known = register_calibration(services.catalogue, services.archive, one, LATE)
            numbers.append(known.number)
        drift = calibration_drift.drift(services, "stand")
    late, untimed, early = numbers
    listed = answer("calibration", "list", "--rig", "stand", *at)
    assert [one["id"] for one in listed] == [late, early, untimed]
    assert [one["valid_from"] is None for one in listed] == [False, False, True]
    assert answer("calibration", "show", str(untimed), *at)["valid_from"] is None
    for command in (("list",), ("show", str(untimed)), ("accept", str(untimed))):
        said = inside("calibration", *command, *at)
        assert said.returncode == 0, said.stderr
        assert "2000-01-01" not in said.stdout + said.stderr
    assert said.stderr.strip() == f"calibration {untimed} is used for rig stand"
    # It counts as the first, with which the others are compared, but days since then are not known.
    assert (drift.first, drift.valid_from) == (untimed, None)
    assert {one.calibration for one in drift.moved} == {late, early}
    assert calibration_drift.drift_chart(drift) == ""


def test_it_is_not_said_to_be_valid_since_a_time_that_nobody_knows() -> None:
    assert valid_from(LATE) == "valid from 2026-05-04 00:00:00+00:00 on"
    assert (
        valid_from(UNTIMED) == "taken as valid from 2000-01-01 00:00:00+00:00 on, since its time is not known"
    )


def test_a_measurement_before_it_is_told_that_its_time_is_not_known(home: Path) -> None:
    make_home(home, {})
    made, campaign = small_plate("old")
    campaign = replace(campaign, states=tuple(replace(one, time=EARLY) for one in campaign.states))
    with bootstrap.services(home) as services:
        register_campaign(
            services.catalogue, services.archive, campaign, replace(made, valid_from=UNTIMED), LATE
        )
    refused = inside("job", "submit", "simulate", "reconstruct", "-c", "old", "--home", str(home))
    assert "is of 1999-05-04" in refused.stderr
    assert "taken as valid from 2000-01-01" in refused.stderr
