"""Numbers of what happened, in the order in which they become visible."""

from __future__ import annotations

from sms_jobs.web.following import GIVEN_UP_AFTER_S, Order


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
