"""Hosts of one name, clocks that are wrong or set, machines that sleep: no living job is given up."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta

import pytest
from sqlalchemy import select
from support.jobs import NOW, claim, state, submit_pipeline

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.workers import WorkerRow
from sms_jobs.jobs.running import lifecycle, recovery
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.jobs.running.origin import Origin
from sms_jobs.jobs.running.witness import Witness
from sms_jobs.records.job import JobState

QUEUES = ["cpu", "io", "acquisition"]
LEASE_S = 30.0
NAME = "rig-pc"
BUDGET = 3
PID = 1
"""Of the first process in every container; of the supervisor and of what it has started alike."""
CLONE = Origin("one image", "one boot each", "pid:[4026531836]", 4)


class Host:
    """A supervisor as it is on one of several machines with the same name, with a clock of its own."""

    def __init__(self, catalogue: Catalogue, number: int, ahead: timedelta) -> None:
        self.worker_id = f"h{number}"
        self.ahead = ahead
        self.living = {PID}
        self._catalogue = catalogue
        origin = replace(CLONE, boot=f"boot {number}")
        self._witness = Witness(self.worker_id, origin)
        with catalogue.writing() as session:
            recovery.register_worker(
                session,
                self.worker_id,
                NAME,
                PID,
                QUEUES,
                2,
                NOW + ahead,
                origin=origin,
                lease=timedelta(seconds=LEASE_S),
            )

    def now(self, elapsed_s: float) -> datetime:
        return NOW + self.ahead + timedelta(seconds=elapsed_s)

    def claim(self, elapsed_s: float = 0.0) -> Claim:
        with self._catalogue.writing() as session:
            held = lifecycle.claim(session, QUEUES, self.worker_id, PID, self.now(elapsed_s))
        assert held is not None
        return held

    def beat(self, elapsed_s: float) -> None:
        with self._catalogue.writing() as session:
            recovery.beat(session, self.worker_id, self.now(elapsed_s))

    def recover(self, elapsed_s: float, monotonic_s: float | None = None) -> list[str]:
        with self._catalogue.writing() as session:
            silent = self._witness.silent(session, elapsed_s if monotonic_s is None else monotonic_s)
            return recovery.recover(
                session, self.now(elapsed_s), self.worker_id, BUDGET, lambda: self.living, silent
            )


@pytest.fixture
def hosts(catalogue: Catalogue) -> list[Host]:
    """Four of them, whose clocks differ by hours."""
    for number in range(4):
        submit_pipeline(catalogue, f"plate{number}")
    return [Host(catalogue, k, timedelta(hours=ahead)) for k, ahead in enumerate((0, 1, -1, 24))]


def test_hosts_of_one_name_leave_each_others_jobs_alone(catalogue: Catalogue, hosts: list[Host]) -> None:
    held = [host.claim() for host in hosts]
    for second in range(120):
        for host in hosts:
            if second % 10 == 0:
                host.beat(second)
            assert host.recover(second) == []
    assert {state(catalogue, one.job_id) for one in held} == {JobState.RUNNING}


def test_a_clock_that_is_set_gives_up_nothing(catalogue: Catalogue, hosts: list[Host]) -> None:
    held = hosts[0].claim()
    for second in range(60):
        for host, jump in zip(hosts, (1, -1, 24, 0), strict=True):
            if second == 20:
                host.ahead += timedelta(hours=jump)
            if second % 10 == 0:
                host.beat(second)
            assert host.recover(second) == []
    assert state(catalogue, held.job_id) is JobState.RUNNING


def test_one_that_is_silent_for_its_lease_is_given_up_by_each_who_watched(
    catalogue: Catalogue, hosts: list[Host]
) -> None:
    held = hosts[0].claim()
    hosts[0].beat(0)
    for second in range(int(LEASE_S) + 1):
        assert hosts[1].recover(second) == []
    # Who begins to watch now has seen nothing yet.
    assert hosts[2].recover(LEASE_S + 2) == []
    assert hosts[1].recover(LEASE_S + 2) == [held.job_id]
    # It lives, and hears from its next beat on that it may go on; what it held is another's.
    with catalogue.writing() as session:
        assert session.get_one(WorkerRow, "h0").given_up
        assert not lifecycle.succeed(session, held, NOW, "late", reuse_key="late")
        assert lifecycle.claim(session, QUEUES, "h0", PID, NOW) is None
    hosts[0].beat(100)
    assert state(catalogue, held.job_id) is JobState.QUEUED
    hosts[0].claim(100)


def test_who_could_not_look_judges_nobody(catalogue: Catalogue, hosts: list[Host]) -> None:
    held = hosts[0].claim()
    # The database was away for an hour, or the one who watches was stopped, or slept.
    assert [hosts[1].recover(s, s) for s in (0, 1, 3600, 3601)] == [[]] * 4
    assert state(catalogue, held.job_id) is JobState.RUNNING


def test_processes_are_judged_by_who_has_started_them(catalogue: Catalogue, hosts: list[Host]) -> None:
    held = hosts[0].claim()
    # In the others' name spaces nobody has that number any more.
    for host in hosts[1:]:
        host.living = set()
        assert host.recover(0) == []
    hosts[0].living = set()
    assert hosts[0].recover(1) == [held.job_id]


def test_one_that_was_here_and_is_gone_is_silent_at_once(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    here = Origin.own()
    if not here.boot:
        pytest.skip("nothing tells here where a process is")
    with catalogue.writing() as session:
        row = session.scalars(select(WorkerRow)).one()
        # No process has this number.
        row.pid, row.machine, row.boot = 2**22 + 1, here.machine, here.boot
        row.pid_namespace, row.process_started = here.pid_namespace, 1
    held = claim(catalogue)
    assert held is not None
    with catalogue.writing() as session:
        assert Witness("w2", replace(here, boot="another")).silent(session, 0.0) == []
        assert Witness("w2", here).silent(session, 0.0) == ["w1"]
