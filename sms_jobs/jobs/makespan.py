"""How long a graph of jobs takes on some workers: numbers in, seconds out."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray


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
    seconds = np.array([task.seconds for task in tasks])
    queues = np.array([task.queue for task in tasks])
    latest = float(np.max((heads + seconds)[leads]))
    groups = [(np.ones(len(tasks), bool), sum(p.count for p in places))]
    groups += [
        (queues == queue, sum(p.count for p in places if queue in p.queues))
        for queue in {task.queue for task in tasks if task.requested}
    ]
    for chosen, count in groups:
        if count == 0:
            return inf
        # What does not lead to the end only takes time: it counts with all that has yet to be done.
        latest = max(latest, _shared(tails[chosen], seconds[chosen], count))
        latest = max(latest, _shared(heads[chosen & leads], seconds[chosen & leads], count))
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


def _around(
    tasks: Sequence[Task],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the longest chains before and behind each task, and whether a requested one depends on it."""
    heads, tails = np.zeros(len(tasks)), np.zeros(len(tasks))
    leads = np.array([task.requested for task in tasks])
    for place, task in enumerate(tasks):
        heads[place] = max((heads[n] + tasks[n].seconds for n in task.needs), default=0.0)
    for place in reversed(range(len(tasks))):
        for need in tasks[place].needs if leads[place] else ():
            leads[need] = True
            tails[need] = max(tails[need], tasks[place].seconds + tails[place])
    return heads, tails, leads


def _shared(apart: NDArray[np.float64], seconds: NDArray[np.float64], count: int) -> float:
    """Return the greatest sum of a distance from one end and the shared work that lies at least so far."""
    if not len(apart):
        return 0.0
    order = np.argsort(-apart, kind="stable")
    return float(np.max(apart[order] + np.cumsum(seconds[order]) / count))
