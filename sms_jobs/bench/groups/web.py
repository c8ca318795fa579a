"""The interface over HTTP: how soon many clients are answered, a field is seen, and an event is told."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median, quantiles
from urllib.parse import urlencode

import httpx2
import numpy as np

from sms_jobs import bootstrap
from sms_jobs.app.work import jobs
from sms_jobs.archive import Provenance
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.large import many_files, many_jobs
from sms_jobs.bench.web_clients import EventEar, Served, crowd, served
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.models import FileRow
from sms_jobs.records.fields import Surface
from sms_jobs.records.job import JobState
from sms_jobs.records.subject import Subject

_FILES, _QUICK_FILES = 1_000_000, 20_000
_JOBS, _QUICK_JOBS = 100_000, 5_000
_CLIENTS = 50
_PAUSE_S = 5.0
"""As somebody who looks at one page after the other."""
_SECONDS, _QUICK_SECONDS = 60.0, 10.0
_SIDE, _QUICK_SIDE = 2048, 256
_TILES = 3
_EVENTS = 20
_HEARD_WITHIN_S = 30.0
_AT = datetime(2026, 1, 1, tzinfo=UTC)


def _addresses(services: Services) -> list[str]:
    """Return what pages ask for, each as often as it is likely to be asked for."""
    campaign = many_jobs.name_of(0)
    with_jobs = {"campaign": campaign, "limit": 50}
    waiting, queued = (
        jobs.list_jobs(services, campaign=campaign, states=[state], limit=1)[0].id
        for state in (JobState.WAITING, JobState.QUEUED)
    )
    questions = [many_files.DOCUMENTED[place] for place in (0, 1, 6, 8)]
    return [
        "/status",
        f"/jobs?{urlencode(with_jobs)}",
        f"/jobs?{urlencode(with_jobs | {'states': 'queued'})}",
        f"/campaigns/{campaign}/progress",
        *(f"/data/find?{urlencode({'query': text})}" for text in questions),
        "/calibrations",
        f"/jobs/{waiting}",
        f"/jobs/{queued}/explain",
    ]


def _fields(services: Services, side: int) -> list[int]:
    """Seal surfaces of so many pixels a side, and return their numbers."""
    random = np.random.default_rng(20_031)
    y, x = np.mgrid[0:side, 0:side]
    numbers = []
    for attempt in range(1, _TILES + 1):
        noise = random.normal(0.0, 0.01, (3, side, side))
        position = np.stack([0.1 * x, 0.1 * y, 50.0 * np.cos(x / 300.0)]) + noise
        record = Surface("C1P1", "mm", position, np.zeros((side, side), np.uint32))
        made = Provenance("speed", 1, Subject("speed"), "speed", attempt, _AT, {}, (), "0", "here", "me")
        sealed = services.archive.seal_dataset({"surface": record}, made)
        row = FileRow(
            source="speed",
            path=sealed.path,
            content_hash=sealed.content_hash,
            size_bytes=sealed.size_bytes,
            sha256=sealed.sha256,
            media_type=sealed.media_type,
            created_at=_AT,
        )
        with services.catalogue.writing() as session:
            session.add(row)
            session.flush()
            numbers.append(row.id)
    return numbers


def _first_tiles(web: Served, numbers: Sequence[int]) -> list[float]:
    """Return the ms until somebody who opens the page of a field has its first picture."""
    taken = []
    with httpx2.Client(base_url=web.url, timeout=60.0) as client:
        for number in numbers:
            began = time.perf_counter()
            client.get(f"/fields/{number}/first.png").raise_for_status()
            taken.append(1e3 * (time.perf_counter() - began))
    return taken


def _event_delays(services: Services, web: Served) -> list[float]:
    """Return the ms from a change of a job, once it is committed, to the client who hears of it."""
    some = jobs.list_jobs(services, states=[JobState.QUEUED], limit=_EVENTS)
    taken = []
    with EventEar(web.url) as ear:
        time.sleep(1.0)  # until it listens
        for job in some:
            jobs.cancel(services, [job.id], None)
            committed = time.perf_counter()
            taken.append(1e3 * max(ear.heard_at(job.id, _HEARD_WITHIN_S) - committed, 0.0))
    return taken


def _slowest(taken: dict[str, list[float]]) -> str:
    """Return the addresses by their median, the slowest first."""
    middle = {address: median(times) for address, times in taken.items() if times}
    ordered = sorted(middle, key=lambda address: -middle[address])
    return "; ".join(f"{address.partition('?')[0]} {middle[address]:.0f} ms" for address in ordered[:4])


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    files, active = (_QUICK_FILES, _QUICK_JOBS) if run.quick else (_FILES, _JOBS)
    side = _QUICK_SIDE if run.quick else _SIDE
    home = run.folder / "web"
    home.mkdir()
    bootstrap.initialise(home)
    with bootstrap.services(home) as services:
        many_files.fill(services.catalogue, files, lambda text: run.say(f"web: {text}"))
        many_jobs.fill_queue(services.catalogue, active, datetime.now(UTC), run.say)
        yield from _measured(
            run, services, home, side, f"{files} files and {active} jobs that have not ended"
        )


def _measured(run: Run, services: Services, home: Path, side: int, filled: str) -> Iterator[Found]:
    numbers, addresses = _fields(services, side), _addresses(services)
    seconds = _QUICK_SECONDS if run.quick else _SECONDS
    with served(home) as web:
        run.say("web: first tiles of fields")
        tile = median(_first_tiles(web, numbers))
        run.say(f"web: {_CLIENTS} clients")
        with httpx2.Client(base_url=web.url, timeout=60.0) as client:
            for address in addresses:  # what is loaded once does not count
                client.get(address).raise_for_status()
        taken = crowd(web.url, addresses, _CLIENTS, _PAUSE_S, seconds)
        every = [ms for times in taken.values() for ms in times]
        rss = web.rss_mb
        run.say("web: events")
        delays = _event_delays(services, web)
    p95 = quantiles(every, n=20)[-1]
    whole = None if run.quick else 1.0
    yield Figure("p95_ms", whole and p95, "ms", 100.0, "at most")
    yield Figure("first_tile_ms", whole and tile, "ms", 200.0, "at most")
    yield Figure("event_delay_ms", whole and quantiles(delays, n=20)[-1], "ms", 500.0, "at most")
    yield Figure("rss_mb", whole and rss, "MB", 300.0, "at most")
    yield Condition(
        "p95",
        f"{filled}, on SQLite; {_CLIENTS} clients of one 'sms serve' on this machine, each of which asks, "
        f"gets its answer, and pauses {_PAUSE_S:g} s, for {seconds:g} s; {len(every)} answers to "
        f"{len(addresses)} addresses in equal parts: median {median(every):.0f} ms, 95 % within "
        f"{p95:.0f} ms; slowest by median: {_slowest(taken)}",
    )
    yield Condition(
        "first_tile",
        f"the picture that the page of a field of {side} x {side} px in float64 shows first, of a file that "
        f"this process never read: {tile:.0f} ms, median of {_TILES}; files in the system's cache",
    )
    yield Condition(
        "event_delay",
        f"from the return of the commit that cancels a job to the client of /events, 95 % of {_EVENTS} "
        f"jobs; median {median(delays):.0f} ms",
    )
    yield Condition("rss", f"of the process that serves, after these clients: {rss:.0f} MB")


GROUP = Group("web", "the interface over HTTP", lambda: None, measure)
