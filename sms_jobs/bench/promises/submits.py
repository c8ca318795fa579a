"""A crowd that submits at once: all are served, and none waits long, since none holds the lock for long."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from math import ceil
from pathlib import Path

from sms_jobs import bootstrap
from sms_jobs.bench.crowd import Visit, crowd
from sms_jobs.bench.figures import Condition, Figure, Found, Run
from sms_jobs.bench.promises import Promise
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.jobs.asking import inquiry
from sms_jobs.virtual_rig.campaigns import small_plate

_CROWD = 200
_QUICK = 24


def submissions(home: Path, count: int, folder: Path) -> list[Visit]:
    """Submit the recording of a small campaign from so many processes at once; the home is made."""
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        calibration, campaign = small_plate("plate")
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
    return crowd(["job", "submit", "simulate", "-c", "plate", "--home", str(home)], count, folder)


def measure(run: Run) -> Iterator[Found]:
    """Yield how many submissions were done, the longest lock, and how long the last but few waited for it."""
    count = _QUICK if run.quick else _CROWD
    home, reports = run.folder / "submits", run.folder / "submits-reports"
    reports.mkdir()
    run.say(f"promises: {count} submissions at once")
    visits = submissions(home, count, reports)
    done = [visit for visit in visits if visit.exit_code == 0]
    waits = sorted(visit.waited_s for visit in visits)
    yield Figure("concurrent_submits_done", None if run.quick else len(done), "", _CROWD)
    yield Figure("submit_longest_lock_ms", 1e3 * max(v.held_s for v in visits), "ms", 50.0, "at most")
    yield Figure("submit_wait_p99_s", waits[ceil(0.99 * count) - 1], "s", 1.0, "at most")
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        jobs = sum(inquiry.counts(session).values())
    yield Condition(
        "submits",
        f"{count} processes of 'sms job submit simulate' on one SQLite catalogue, forked from one that has "
        f"loaded the program and started at the same moment: {len(done)} ended with exit code 0, {jobs} jobs "
        "are there, two of each; the lock from BEGIN IMMEDIATE to the end of the commit, its waiting before",
    )


PROMISE = Promise("submits", measure)
