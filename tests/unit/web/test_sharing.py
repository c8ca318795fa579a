"""What many ask for at once is found once, and not kept longer than a moment."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from sms_jobs.web.sharing import Shared


def test_many_who_ask_at_once_are_answered_by_one() -> None:
    shared: Shared[int] = Shared()
    found, together = [], threading.Barrier(8)

    def find() -> int:
        time.sleep(0.05)
        found.append(1)
        return len(found)

    def ask(_: int) -> int:
        together.wait()
        return shared.of("status", find)

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(ask, range(8))) == {1}
    assert shared.of("other", find) == 2


def test_after_a_moment_it_is_found_again() -> None:
    shared: Shared[int] = Shared(fresh_s=0.02)
    numbers = iter(range(3))
    assert shared.of("a", lambda: next(numbers)) == shared.of("a", lambda: next(numbers)) == 0
    time.sleep(0.03)
    assert shared.of("a", lambda: next(numbers)) == 1


def test_what_failed_is_tried_by_the_next() -> None:
    shared: Shared[int] = Shared()
    with pytest.raises(ZeroDivisionError):
        shared.of("a", lambda: 1 // 0)
    assert shared.of("a", lambda: 7) == 7
