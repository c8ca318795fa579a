"""A load is held when it has stayed near its target, without a break, for long enough."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.instruments.holding import Hold, HoldDetector, StandstillDetector

HOLD = Hold(1000.0, 5.0, 10.0)


def test_a_load_is_held_after_its_time() -> None:
    detector = HoldDetector(HOLD)
    told = [detector.held(t, v) for t, v in [(0, 900), (1, 996), (5, 1004), (10.9, 1000), (11, 995)]]
    assert told == [False, False, False, False, True]


def test_leaving_the_band_begins_anew() -> None:
    detector = HoldDetector(HOLD)
    told = [detector.held(t, v) for t, v in [(0, 1000), (9, 1006), (10, 1000), (19, 1000), (20, 1000)]]
    assert told == [False, False, False, False, True]


def test_what_is_no_number_is_not_held() -> None:
    detector = HoldDetector(HOLD)
    assert [detector.held(t, float("nan")) for t in (0.0, 20.0)] == [False, False]


@given(st.lists(st.tuples(st.floats(0.01, 5.0), st.floats(980.0, 1020.0)), min_size=1, max_size=60))
def test_held_means_that_nothing_was_outside_for_that_long(steps: list[tuple[float, float]]) -> None:
    detector, now, seen = HoldDetector(HOLD), 0.0, []
    for step, value in steps:
        now += step
        seen.append((now, abs(value - HOLD.target) <= HOLD.tolerance))
        inside = []
        for t, near in reversed(seen):
            if not near:
                break
            inside.append(t)
        expected = bool(inside) and now - inside[-1] >= HOLD.for_s
        assert detector.held(now, value) == expected


def test_a_counter_stands_still_at_its_number() -> None:
    detector = StandstillDetector(1000, 2.0)
    told = [(0, 998.0), (1, 998.0), (4, 998.0), (5, 1001.0), (6, 1002.0), (7.9, 1002.0), (8, 1002.0)]
    assert [detector.held(t, v) for t, v in told] == [False] * 6 + [True]


def test_a_counter_that_goes_on_is_enough_where_nothing_has_to_stand() -> None:
    detector = StandstillDetector(1000, 0.0)
    assert [detector.held(t, v) for t, v in [(0, 999.0), (1, 1000.0), (2, 1001.0)]] == [False, True, True]


def test_what_is_no_number_counts_nothing() -> None:
    detector = StandstillDetector(1000, 2.0)
    assert [detector.held(t, float("nan")) for t in (0.0, 20.0)] == [False, False]
