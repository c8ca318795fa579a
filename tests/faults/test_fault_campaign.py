"""Nothing is lost and nothing done twice, whatever breaks at whatever moment; on both deployments."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import pytest
from sqlalchemy import func, select
from support.command import sms, wait_until
from support.fault_campaign import FaultCampaign, Place, Verdict, judge, prepare
from support.missing import do_without
from support.servers import PostgresqlServer, RedisServer, postgresql_programs

from sms_jobs.catalogue.tables.jobs import JobRow

KILLS = (
    *(5 * ["busy process killed"]),
    "idle process killed",
    "nursery killed",
    "supervisor killed, and with it the publisher",
)
"""In the long form these take turns."""


def missing(what: str) -> NoReturn:
    do_without(f"needs {what} to start a server of its own: install it, or run ops/test.sh")


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[tuple[Path, bool]]:
    """A folder, and whether it is a file system of its own that may be filled up."""
    folder = tmp_path / "disk"
    folder.mkdir()
    # Never full by what jobs leave, or all wait for room that nobody makes: a thousand leave a gigabyte, and
    # there are as many as the machine is quick. It takes no more memory than is written to it.
    mount = ["mount", "-t", "tmpfs", "-o", "size=4000m", "none", str(folder)]
    mounted = os.geteuid() == 0 and subprocess.run(mount, capture_output=True, check=False).returncode == 0
    try:
        yield folder, mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture(params=["embedded", "grown"])
def place(request: pytest.FixtureRequest, disk: tuple[Path, bool], tmp_path: Path) -> Iterator[Place]:
    """A deployment that belongs to this test alone, with its servers."""
    folder, may_be_filled = disk
    if request.param == "embedded":
        # Catalogue and archive on one disk: when it is full, neither can be written.
        yield Place(folder / "home", folder / "archive", may_be_filled)
        return
    programs = postgresql_programs()
    if programs is None:
        missing("PostgreSQL")
    if shutil.which("redis-server") is None:
        missing("Redis")
    assert programs is not None
    # A short path: that of a unix socket is limited. Not below pytest's, which is root's alone.
    server = Path(tempfile.gettempdir()) / f"sms-faults-{os.getpid()}"
    postgresql = PostgresqlServer(server, programs)
    redis = RedisServer(tmp_path / "redis")
    try:
        yield Place(tmp_path / "home", folder / "archive", may_be_filled, postgresql=postgresql, redis=redis)
    finally:
        redis.kill()
        postgresql.crash()
        shutil.rmtree(server)


@pytest.mark.parametrize("place", ["embedded"], indirect=True)
def test_a_disk_that_was_full_has_room_for_a_thousand_jobs(place: Place) -> None:
    if not place.may_be_filled:
        pytest.skip("only root may mount a file system")
    prepare(place, states=1)
    campaign = FaultCampaign(place, seed=1, absence_s=0.0)

    def free() -> int:
        return shutil.disk_usage(place.archive).free

    with closing(campaign.catalogue), ThreadPoolExecutor() as beside:
        filled = beside.submit(campaign.fill_disk)
        wait_until(lambda: free() < 1e5)
        assert filled.result()
    assert free() > 1e9


def test_every_fault_once(place: Place) -> None:
    place = replace(place, lease_s=2.0)
    prepare(place, states=8)
    campaign = FaultCampaign(place, seed=7, absence_s=1.0)
    with campaign.served():
        # Last those after which programs have to be started again.
        for name in sorted(campaign.faults, key=KILLS[-2:].__contains__):
            # A process is idle for certain only where there are fewer jobs than processes.
            least = 1 if name == "idle process killed" else 6
            for _ in range(100):  # the job that it is aimed at may end before it is hit
                if campaign.left() < least:
                    campaign.submit("simulate", "reconstruct")
                hit = campaign.inject(name)
                campaign.rest(1)
                if hit:
                    break
        campaign.settle()
    assert judge(place) == Verdict(campaign.jobs)
    assert set(campaign.injected.values()) == {1}, campaign.injected


@pytest.mark.long
@pytest.mark.parametrize(("restarts", "read_only_s"), [(4, 10.0), (50, 600.0)], ids=["short", "whole"])
def test_outages_of_database_and_archive_cost_no_job_anything(
    place: Place, tmp_path: Path, restarts: int, read_only_s: float
) -> None:
    # With the budget that is the default: an outage is no crash. The catalogue's disk stays as it is.
    place = replace(place, home=tmp_path / "home", settings={"SMS_CRASH_BUDGET": "3", "SMS_WORKERS": "2"})
    if not place.may_be_filled:
        pytest.skip("only root may mount a file system")
    prepare(place, states=40)
    campaign = FaultCampaign(place, seed=3, absence_s=0.0)
    with campaign.served():
        for number in range(restarts):
            if campaign.left() < 10:
                campaign.submit("simulate", "reconstruct")
            if place.postgresql is not None:
                campaign.restart_database()
            if number % (restarts // 2) == 0:
                assert campaign.make_read_only(read_only_s / 2)
            campaign.rest(1)
        campaign.settle()
    assert judge(place) == Verdict(campaign.jobs)
    with closing(place.catalogue()) as catalogue, catalogue.reading() as session:
        crashes, tries = session.execute(select(func.sum(JobRow.crashes), func.sum(JobRow.tries))).one()
    assert (crashes, tries) == (0, 0)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1])
def test_two_hundred_kills_over_a_thousand_jobs(place: Place, seed: int) -> None:
    prepare(place, states=500)
    campaign = FaultCampaign(place, seed, absence_s=60.0)
    others = [name for name in campaign.faults if name not in KILLS]
    plan = [KILLS[n % len(KILLS)] for n in range(200)]
    plan += others + [name for name in others if name != "broker absent"]
    campaign.shuffle(plan)
    started = time.monotonic()
    with campaign.served():
        campaign.submit("simulate", "reconstruct")
        while plan:
            # A process is idle for certain only where there are fewer jobs than processes: then all but a few
            # are let come to their end, and more are submitted afterwards.
            idle = plan[-1] == "idle process killed"
            if campaign.left() < (1 if idle else 10):
                campaign.submit("simulate", "reconstruct", states=20)
            if campaign.inject(plan[-1]):
                plan.pop()
            elif idle:
                campaign.rest(campaign.left())
            # So that what is to come meets all jobs, from the first to the last, and none runs out of them.
            campaign.rest(2 * max(campaign.left() - 40, 0) // (len(plan) + 1))
            print(
                f"{campaign.kills} kills, {campaign.left()} jobs left, {len(plan)} faults to come", flush=True
            )
        campaign.settle()
    took = time.monotonic() - started
    verdict = judge(place)
    print(
        f"\n{verdict.jobs} jobs, {verdict.attempts} attempts, {campaign.kills} kills, {took:.0f} s, "
        f"{len(verdict.lost)} lost, {len(verdict.duplicated)} duplicated; {dict(campaign.injected)}"
    )
    assert verdict == Verdict(campaign.jobs)
    verified = sms("archive", "verify", "--home", str(place.home), environment=place.environment)
    assert verified.returncode == 0, verified.stdout + verified.stderr
