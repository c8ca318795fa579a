"""The calendar of schedules: every coming time on its day, in the zone in which days are counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest
from support.homes import make_home

from sms_jobs import bootstrap
from sms_jobs.app.work import schedules as use_cases
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.scheduling import schedules
from sms_jobs.jobs.scheduling.fire_times import fire_times, parse_expression
from sms_jobs.jobs.scheduling.schedules import Order
from sms_jobs.records.shown.schedules import MOST_A_DAY

NOW = datetime(2026, 3, 10, 9, 30, tzinfo=UTC)
LONDON = ZoneInfo("Europe/London")
MARCH = date(2026, 3, 1)
WHEN = {
    "nightly": "cron 30 23 * * *",
    "weekly": "cron 0 8 * * 1",
    "hourly": "every 1h",
    "often": "every 1m",
    "leap": "cron 0 0 29 2 *",
    "once": "at 2026-03-31T23:45",
    "then": "after plate",
    "held": "cron 0 12 * * *",
}


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    make_home(tmp_path / "home", {})
    with bootstrap.services(tmp_path / "home") as opened:
        for name, when in WHEN.items():
            expression = parse_expression(when, "Europe/London")
            order = Order("plate", (Request("simulate"),))
            schedules.add(opened.catalogue, name, expression, order, NOW)
        use_cases.set_paused(opened, "held", True)
        yield opened


def test_each_coming_time_stands_on_its_day(services: Services) -> None:
    with services.catalogue.reading() as session:
        found = schedules.calendar(session, MARCH, 31, LONDON, NOW)
    counted = {(one.schedule, one.day): one for one in found}
    for name, when in WHEN.items():
        times = []
        for moment in fire_times(parse_expression(when, "Europe/London"), NOW, NOW):
            if moment.astimezone(LONDON).date() > date(2026, 3, 31):
                break
            times.append(moment)
        expected = Counter(moment.astimezone(LONDON).date() for moment in times) if name != "held" else {}
        assert {day: one.count for (of, day), one in counted.items() if of == name} == {
            day: min(count, MOST_A_DAY) for day, count in expected.items()
        }, name
        for day in expected:
            assert counted[name, day].first == min(t for t in times if t.astimezone(LONDON).date() == day)
    # Summer time begins on 29 March, a day of 23 hours.
    assert counted["hourly", date(2026, 3, 29)].count == 23
    assert counted["nightly", date(2026, 3, 28)].first == datetime(2026, 3, 28, 23, 30, tzinfo=UTC)
    assert counted["nightly", date(2026, 3, 29)].first == datetime(2026, 3, 29, 22, 30, tzinfo=UTC)
    assert [one.day for one in found] == sorted(one.day for one in found)
    assert min(one.day for one in found) == NOW.date()


def test_a_month_that_is_past_has_nothing_and_one_far_ahead_is_found(services: Services) -> None:
    with services.catalogue.reading() as session:
        assert schedules.calendar(session, date(2026, 2, 1), 28, LONDON, NOW) == []
        leap = schedules.calendar(session, date(2028, 2, 1), 29, LONDON, NOW)
    assert [one.day for one in leap if one.schedule == "leap"] == [date(2028, 2, 29)]
    assert leap[0].first > NOW + timedelta(days=600)


@pytest.mark.parametrize("month", ["2026", "2026-13", "26-05", "1999-05", "2026-05-01", "may"])
def test_what_is_no_month_is_refused(services: Services, month: str) -> None:
    with pytest.raises(InvalidInput, match="write it as 2026-05"):
        use_cases.calendar(services, month)
    with pytest.raises(InvalidInput, match="no time zone"):
        use_cases.calendar(services, "2026-05", "Atlantis")
