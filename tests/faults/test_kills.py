"""Whichever process is killed or stopped, the next job begins soon, and the service ends when it is told."""

from __future__ import annotations

import os
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import psutil
import pytest
from support.command import service, wait_until
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import events

from sms_jobs.bench.recorded.kill_campaign import KillCampaign, Outcome, plan
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.asking import inquiry
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.planning.submission import submit
from sms_jobs.records.job import JobState

LONGEST_STALL_S = 30.0
LONGEST_END_S = 15.0


@pytest.fixture(params=["embedded", "grown"])
def environment(request: pytest.FixtureRequest) -> dict[str, str]:
    """Settings of either deployment."""
    if request.param == "embedded":
        return {}
    return {
        "SMS_DATABASE_URL": request.getfixturevalue("fresh_postgresql_url"),
        "SMS_BROKER_URL": request.getfixturevalue("redis_url"),
    }


def campaign(home: Path, environment: dict[str, str], places: int, kills: int, stops: int) -> Outcome:
    rng = np.random.default_rng(places)
    fired = KillCampaign(home, environment, places, rng)
    outcome = fired.run(plan(kills, stops, rng), lambda said: print(said, flush=True))
    print(f"\n{outcome}")
    return outcome


def judge(outcome: Outcome, kills: int, stops: int) -> None:
    assert (outcome.lost, outcome.twice) == ([], [])
    assert outcome.kills >= kills
    assert outcome.stops >= stops
    assert max(outcome.stalls_s) <= LONGEST_STALL_S
    assert outcome.idle_end_s <= LONGEST_END_S


def test_a_few_kills_and_stops(home: Path, environment: dict[str, str]) -> None:
    judge(campaign(home, environment, places=2, kills=4, stops=2), 4, 2)


@pytest.mark.long
@pytest.mark.parametrize("places", [2, 4, 8])
def test_two_hundred_kills(home: Path, environment: dict[str, str], places: int) -> None:
    judge(campaign(home, environment, places, kills=200, stops=40), 200, 40)


@pytest.mark.long  # it waits until silence counts as hanging
def test_places_that_hang_are_replaced(home: Path) -> None:
    make_home(home, {})
    hanging = home / "messages" / "queue" / "0_0.sms.cpu.msg"
    with service(home, {"SMS_WORKERS": "2"}) as supervisor:
        places = wait_until(lambda: [p.pid for n in supervisor.children() for p in n.children()][:2])
        # Who opens it waits for ever: alive, not stopped, and deaf.
        os.mkfifo(hanging)
        log = home / "up.log"
        wait_until(lambda: log.read_text().count("gives no sign of life; killing it") >= len(places))
        hanging.unlink()
        catalogue = Deployment("embedded", home, {}).catalogue()
        first = submitted(catalogue)
        wait_until(lambda: ended(catalogue), timeout=LONGEST_STALL_S)
        assert [e.state for e in events(catalogue, first)] == ["queued", "running", "succeeded"]
        catalogue.close()


def test_a_nursery_that_is_stopped_while_it_loads_is_woken(home: Path) -> None:
    make_home(home, {})
    with service(home, {"SMS_WORKERS": "1"}) as supervisor:
        # It has not said yet that it is there: to load kinds takes it a second. Stopped between fork and exec
        # it would hold up who forks it, for the kernel lets that one wait until its child has a program.
        (nursery,) = wait_until(
            lambda: [p for p in supervisor.children() if "sms_jobs.workers.nursery" in p.cmdline()]
        )
        nursery.suspend()
        wait_until(lambda: [p for n in supervisor.children() for p in n.children()], timeout=LONGEST_STALL_S)


def submitted(catalogue: Catalogue) -> str:
    with catalogue.writing() as session:
        return submit(session, "plate", [Request("simulate")], datetime.now(UTC)).job_ids[0]


def ended(catalogue: Catalogue) -> bool:
    with catalogue.reading() as session:
        return set(inquiry.counts(session)) == {JobState.SUCCEEDED.value}


def test_what_compiles_kernels_is_woken_when_it_was_stopped(home: Path, tmp_path: Path) -> None:
    make_home(home, {})
    with service(home, {"SMS_WORKERS": "1", "NUMBA_CACHE_DIR": str(tmp_path / "nothing-is-compiled")}) as up:

        def compiling() -> list[psutil.Process]:
            with suppress(psutil.NoSuchProcess):
                return [p for n in up.children() for p in n.children() if p.nice() > up.nice()]
            return []

        def worked_s() -> float:
            times = process.cpu_times()
            return times.user + times.system

        (process, *_) = wait_until(compiling)
        process.suspend()
        # It may be woken before anyone sees it stopped; what is never woken works no more.
        enough_s = worked_s() + 0.5
        wait_until(lambda: worked_s() > enough_s, timeout=LONGEST_STALL_S)
