"""How long a graph of jobs takes on some workers: numbers in, seconds out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from math import inf
from operator import itemgetter


@dataclass(frozen=True)
class Task:
    """One job that has not ended.

    Attributes
    ----------
    seconds
        What it takes from now on.
    queue
        That it comes from.
    needs
        Places of the tasks that have to end before it begins; each comes before it in the sequence.
    requested
        Whether its end is waited for; others only take workers' time before that.
    """

    seconds: float
    queue: str
    needs: tuple[int, ...] = ()
    requested: bool = True


@dataclass(frozen=True)
class Places:
    """Jobs that a worker runs at the same time, and the queues that it takes them from."""

    queues: frozenset[str]
    count: int


def makespan(tasks: Sequence[Task], places: Sequence[Places]) -> float:
    """Return the seconds until the last requested task has ended; infinite where nobody serves a queue.

    No order of the tasks ends sooner: it is the greatest of the longest chain (critical path) and, for every
    moment, the work that cannot begin before it (or that others wait for after it) shared by all who can do
    it, added to that moment; of all tasks and of those of each queue (Fernandez and Bussell 1973). Workers
    that take the first job that is ready come close to it, and unlike what they do exactly, it never grows
    with more workers nor falls with more tasks.
    """
    if not any(task.requested for task in tasks):
        return 0.0
    heads, tails, leads = _around(tasks)
    latest = max(
        head + task.seconds for task, head, leading in zip(tasks, heads, leads, strict=True) if leading
    )
    everything: list[str | None] = [None]
    for queue in everything + sorted({task.queue for task in tasks if task.requested}):
        count = sum(p.count for p in places if queue is None or queue in p.queues)
        if count == 0:
            return inf
        chosen = [n for n, task in enumerate(tasks) if queue is None or task.queue == queue]
        # What does not lead to the end only takes time: it counts with all that has yet to be done.
        behind = [(tails[n], tasks[n].seconds) for n in chosen]
        before = [(heads[n], tasks[n].seconds) for n in chosen if leads[n]]
        latest = max(latest, _shared(behind, count), _shared(before, count))
    return latest


def shared(seconds: Mapping[str, float], requested: Collection[str], places: Sequence[Places]) -> float:
    """Return the seconds until the work of some queues is done, shared by all who can do it.

    That is `makespan` of very many jobs, among which those that wait for others hold nobody up.

    Parameters
    ----------
    seconds
        The work in each queue.
    requested
        Queues whose end is waited for.
    """
    groups = [(frozenset(seconds), sum(p.count for p in places))]
    groups += [
        (frozenset((queue,)), sum(p.count for p in places if queue in p.queues)) for queue in requested
    ]
    if any(count == 0 for _, count in groups):
        return inf
    return max(sum(seconds.get(queue, 0.0) for queue in queues) / count for queues, count in groups)


def _around(tasks: Sequence[Task]) -> tuple[list[float], list[float], list[bool]]:
    """Return the longest chains before and behind each task, and whether a requested one depends on it."""
    heads, tails = [0.0] * len(tasks), [0.0] * len(tasks)
    leads = [task.requested for task in tasks]
    for place, task in enumerate(tasks):
        heads[place] = max((heads[n] + tasks[n].seconds for n in task.needs), default=0.0)
    for place in reversed(range(len(tasks))):
        for need in tasks[place].needs if leads[place] else ():
            leads[need] = True
            tails[need] = max(tails[need], tasks[place].seconds + tails[place])
    return heads, tails, leads


def _shared(tasks: Sequence[tuple[float, float]], count: int) -> float:
    """Return the greatest sum of a distance from one end and the shared work that lies at least so far.

    Each task is given as its distance and its seconds.
    """
    farthest_first = sorted(tasks, key=itemgetter(0), reverse=True)
    work = accumulate(seconds for _, seconds in farthest_first)
    return max(
        (apart + so_far / count for (apart, _), so_far in zip(farthest_first, work, strict=True)), default=0.0
    )
