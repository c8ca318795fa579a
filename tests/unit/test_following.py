"""Numbers of what happened, in the order in which they become visible."""

from __future__ import annotations

from datetime import UTC, datetime

from sms_jobs.app.work.happenings import Cursor, Happening, News
from sms_jobs.records.shown.changes import Change
from sms_jobs.web.following import GIVEN_UP_AFTER_S, Order

AT = datetime(2026, 3, 1, tzinfo=UTC)


def news(jobs: list[int], changes: list[int]) -> News:
    return News(
        [Happening(n, "job", "strain", "a/S0/C1P1", "a", "running", 1, "", AT) for n in jobs],
        [Change(n, "schedule", "night", "", "fired", "", AT) for n in changes],
    )


def test_nothing_is_missing_where_numbers_follow_each_other() -> None:
    order = Order(10)
    order.enter([11, 12, 13], 0.0)
    assert (order.newest, order.safe, order.ranges()) == (13, 13, [])


def test_what_was_left_out_is_looked_for_until_it_comes() -> None:
    order = Order(10)
    order.enter([12, 16], 0.0)
    assert (order.newest, order.safe, order.ranges()) == (16, 10, [(11, 11), (13, 15)])
    order.enter([11, 14], 1.0)
    assert (order.newest, order.safe, order.ranges()) == (16, 12, [(13, 13), (15, 15)])


def test_what_never_comes_is_given_up() -> None:
    order = Order(0)
    order.enter([2], 0.0)
    order.enter([4], GIVEN_UP_AFTER_S / 2)
    order.enter([], GIVEN_UP_AFTER_S)
    assert (order.safe, order.ranges()) == (2, [(3, 3)])


def test_a_long_gap_does_not_take_all_memory() -> None:
    order = Order(0)
    order.enter([10_000_000], 0.0)
    assert order.newest == 10_000_000
    assert sum(last - first + 1 for first, last in order.ranges()) <= 20_000


def test_whoever_breaks_off_anywhere_goes_on_with_all_that_was_not_told() -> None:
    found = news([4, 5, 7], [2, 3])
    # Number 6 of jobs is missing: who heard 7 hears it again, with 6.
    before, safe = Cursor(3, 1), Cursor(5, 3)
    told = found.placed(before, safe)
    assert [cursor for cursor, _ in told] == [
        Cursor(4, 1),
        Cursor(5, 1),
        Cursor(5, 1),
        Cursor(5, 2),
        Cursor(5, 3),
    ]
    for place, (cursor, _) in enumerate(told):
        left = [one for _, one in told[place + 1 :]]
        again = news([n for n in (4, 5, 7) if n > cursor.jobs], [n for n in (2, 3) if n > cursor.changes])
        assert set(left) <= {*again.jobs, *again.changes}


def test_a_place_is_read_back() -> None:
    assert Cursor.parse(str(Cursor(4711, 12))) == Cursor(4711, 12)
    assert Cursor.parse("4711") == Cursor(4711, 0)
