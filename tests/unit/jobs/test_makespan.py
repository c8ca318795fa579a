"""How long graphs of jobs take: laws that hold for every graph."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import replace
from math import inf, isclose

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.jobs.planning.makespan import Places, Task, makespan

QUEUES = ("cpu", "io")
# Sums of some ten numbers in another order differ by their rounding.
ROUNDING = 1e-12


@st.composite
def graphs(draw: st.DrawFn, requested: bool = False) -> list[Task]:
    """Graphs of a few tasks, each of which may need any before it."""
    tasks: list[Task] = []
    for place in range(draw(st.integers(1, 12))):
        needs = draw(st.sets(st.integers(0, place - 1), max_size=3)) if place else set()
        tasks.append(
            Task(
                draw(st.floats(0.0, 1e4)),
                draw(st.sampled_from(QUEUES)),
                tuple(sorted(needs)),
                requested or draw(st.booleans()),
            )
        )
    return tasks


def on(count: int, queues: Sequence[str] = QUEUES) -> Places:
    return Places(frozenset(queues), count)


def not_above(less: float, more: float) -> bool:
    return less <= more * (1.0 + ROUNDING)


def simulated(tasks: Sequence[Task], count: int) -> float:
    """When the last task ends if each free worker takes the first that is ready; the slow, obvious way."""
    ends: dict[int, float] = {}
    running: list[tuple[float, int]] = []
    now, waiting = 0.0, list(range(len(tasks)))
    while waiting or running:
        ready = [i for i in waiting if all(ends.get(n, inf) <= now for n in tasks[i].needs)]
        for i in ready[: count - len(running)]:
            heapq.heappush(running, (now + tasks[i].seconds, i))
            waiting.remove(i)
        now, i = heapq.heappop(running)
        ends[i] = now
    return max(ends.values())


@given(graphs(requested=True), st.integers(1, 4))
def test_it_lies_between_what_is_possible_and_what_workers_do(tasks: list[Task], count: int) -> None:
    estimate, done = makespan(tasks, [on(count)]), simulated(tasks, count)
    assert not_above(estimate, done)
    # Graham 1969: whoever never idles with work at hand takes less than twice the best.
    assert not_above(done, (2.0 - 1.0 / count) * max(estimate, 0.0))


@given(graphs(), st.integers(1, 4), st.integers(0, 4), st.sets(st.sampled_from(QUEUES), min_size=1))
def test_more_workers_are_never_later(tasks: list[Task], count: int, more: int, queues: set[str]) -> None:
    before = makespan(tasks, [on(count)])
    assert not_above(makespan(tasks, [on(count), on(more, sorted(queues))]), before)


@given(graphs(), graphs(), st.integers(1, 4))
def test_another_job_is_never_earlier(tasks: list[Task], others: list[Task], count: int) -> None:
    moved = [replace(t, needs=tuple(n + len(tasks) for n in t.needs)) for t in others]
    together = makespan([*tasks, *moved], [on(count)])
    assert not_above(makespan(tasks, [on(count)]), together)
    assert not_above(makespan(others, [on(count)]), together)


@given(graphs(), st.integers(1, 4), st.data())
def test_a_longer_job_or_one_more_need_is_never_earlier(
    tasks: list[Task], count: int, data: st.DataObject
) -> None:
    before = makespan(tasks, [on(count)])
    place = data.draw(st.integers(0, len(tasks) - 1))
    longer, needing = list(tasks), list(tasks)
    longer[place] = replace(tasks[place], seconds=tasks[place].seconds + 10.0)
    assert not_above(before, makespan(longer, [on(count)]))
    needing[place] = replace(tasks[place], needs=tuple(range(place)))
    assert not_above(before, makespan(needing, [on(count)]))


@given(st.lists(st.floats(0.0, 1e4), min_size=1, max_size=20), st.integers(1, 4))
def test_a_chain_takes_the_sum_however_many_work(seconds: list[float], count: int) -> None:
    chain = [Task(s, "cpu", (i - 1,) if i else ()) for i, s in enumerate(seconds)]
    assert isclose(makespan(chain, [on(count)]), sum(seconds), rel_tol=ROUNDING)


@given(st.lists(st.floats(0.0, 1e4), min_size=1, max_size=20), st.integers(1, 4))
def test_independent_jobs_are_shared(seconds: list[float], count: int) -> None:
    alone = [Task(s, "cpu") for s in seconds]
    shared = max(sum(seconds) / count, max(seconds))
    assert isclose(makespan(alone, [on(count)]), shared, rel_tol=ROUNDING)


def test_what_comes_after_all_else_is_added() -> None:
    # Eight tuples and the report of them: four workers share the tuples, one writes the report.
    tasks = [Task(10.0, "cpu") for _ in range(8)] + [Task(7.0, "cpu", tuple(range(8)))]
    assert makespan(tasks, [on(4)]) == 10.0 * 8 / 4 + 7.0


def test_jobs_of_others_take_time_but_are_not_waited_for() -> None:
    long_chain = [Task(100.0, "cpu", (i - 1,) if i else (), requested=False) for i in range(5)]
    assert makespan([*long_chain, Task(1.0, "cpu")], [on(5)]) == pytest.approx(501.0 / 5)


def test_a_queue_that_nobody_serves_never_ends_unless_nothing_requested_is_in_it() -> None:
    assert makespan([Task(1.0, "io")], [on(2, ["cpu"])]) == inf
    assert makespan([Task(1.0, "io", requested=False), Task(1.0, "cpu")], [on(2, ["cpu"])]) < inf
    assert makespan([], [on(1)]) == 0.0
