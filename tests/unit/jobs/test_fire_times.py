"""When schedules fire, in zones with summer time."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.scheduling.fire_times import next_times, parse_expression, times_until

BEGAN = datetime(2026, 1, 1, tzinfo=UTC)


def times(text: str, zone: str, after: datetime, count: int) -> list[str]:
    return [t.isoformat() for t in next_times(parse_expression(text, zone), BEGAN, after, count)]


def test_two_in_the_morning_is_an_hour_earlier_in_utc_during_summer() -> None:
    # In London the clocks go forward on 29 March 2026 at 01:00.
    found = times("cron 0 2 * * *", "Europe/London", datetime(2026, 3, 28, 0, 0, tzinfo=UTC), 3)
    assert found == ["2026-03-28T02:00:00+00:00", "2026-03-29T01:00:00+00:00", "2026-03-30T01:00:00+00:00"]


def test_a_time_that_spring_leaves_out_comes_at_the_next_minute_there_is() -> None:
    found = times("cron 30 1 * * *", "Europe/London", datetime(2026, 3, 28, 2, 0, tzinfo=UTC), 2)
    assert found == ["2026-03-29T01:00:00+00:00", "2026-03-30T00:30:00+00:00"]


def test_a_time_that_autumn_shows_twice_comes_once() -> None:
    # The clocks go back on 25 October 2026 at 02:00, so that 01:30 is shown at 00:30 and 01:30 UTC.
    found = times("cron 30 1 * * *", "Europe/London", datetime(2026, 10, 24, 12, 0, tzinfo=UTC), 2)
    assert found == ["2026-10-25T00:30:00+00:00", "2026-10-26T01:30:00+00:00"]


@given(
    seconds=st.integers(1, 100_000),
    gone=st.integers(0, 10_000_000),
)
def test_intervals_keep_their_step_however_late_one_looks(seconds: int, gone: int) -> None:
    after = BEGAN + timedelta(seconds=gone)
    first, second = next_times(parse_expression(f"every {seconds}", "UTC"), BEGAN, after, 2)
    assert timedelta(0) < first - after <= timedelta(seconds=seconds)
    assert second - first == timedelta(seconds=seconds)
    assert (first - BEGAN) % timedelta(seconds=seconds) == timedelta(0)


def test_a_time_without_zone_is_on_the_clock_of_the_schedules_zone() -> None:
    assert times("at 2026-05-04T10:00", "Europe/Berlin", BEGAN, 2) == ["2026-05-04T08:00:00+00:00"]
    assert times("at 2026-05-04T10:00+05:00", "Europe/Berlin", BEGAN, 2) == ["2026-05-04T05:00:00+00:00"]


def test_of_very_many_times_the_last_are_returned() -> None:
    every_second = parse_expression("every 1s", "UTC")
    until = BEGAN + timedelta(seconds=5000)
    found = times_until(every_second, BEGAN, BEGAN, until, 10)
    assert found == [BEGAN + timedelta(seconds=s) for s in range(4991, 5001)]


@pytest.mark.parametrize("text", ["every 2h", "every 7200", "every 120m"])
def test_an_expression_reads_itself_back(text: str) -> None:
    assert str(parse_expression(text, "UTC")) == "every 7200"
    assert str(parse_expression(str(parse_expression(text, "UTC")), "UTC")) == "every 7200"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("every 3600", "every 1 h"),
        ("every 90m", "every 90 min"),
        ("every 100s", "every 100 s"),
        ("every 2.5s", "every 2.5 s"),
        ("every 48h", "every 2 d"),
        ("every 12d", "every 12 d"),
        ("every 1234567s", "every 1234567 s"),
        ("every 1.333333m", "every 80 s"),
        ("every 1.3333335d", "every 115200.014 s"),
        ("cron 0 2 * * *", "cron 0 2 * * *"),
    ],
)
def test_an_interval_is_shown_with_its_unit(text: str, shown: str) -> None:
    assert parse_expression(text, "UTC").in_words == shown


@pytest.mark.parametrize(
    ("text", "zone", "complaint"),
    [
        ("cron 61 2 * * *", "UTC", "no cron expression"),
        ("cron 0 2 * *", "UTC", "no cron expression"),
        ("at tomorrow", "UTC", "no time"),
        ("every never", "UTC", "no interval"),
        ("every 0s", "UTC", "at least 1 s"),
        ("after", "UTC", "no schedule"),
        ("sometimes", "UTC", "no schedule"),
        ("cron 0 2 * * *", "Mars/Olympus", "no time zone"),
        ("cron 0 2 * * *", "../../etc/passwd", "no time zone"),
    ],
)
def test_what_is_no_schedule_is_refused(text: str, zone: str, complaint: str) -> None:
    with pytest.raises(InvalidInput, match=complaint):
        parse_expression(text, zone)
