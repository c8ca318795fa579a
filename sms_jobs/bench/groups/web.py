"""The interface over HTTP: how soon many clients are answered, a field is seen, and an event is told."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from statistics import median, quantiles
from urllib.parse import urlencode

import httpx2
import numpy as np

from sms_jobs import bootstrap
from sms_jobs.app.work import jobs
from sms_jobs.archive import Provenance
from sms_jobs.bench.browser import find_browser
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.large import many_files, many_jobs
from sms_jobs.bench.web_clients import API, LISTED, EventEar, PageOfJobs, Served, crowd, served
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.catalogue.tables.calibrations import CalibrationRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.products import CALIBRATED, UNCERTAINTY
from sms_jobs.metrology.geometry.camera import SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.fields import Surface
from sms_jobs.records.job import JobState
from sms_jobs.records.sensors import Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

_FILES, _QUICK_FILES = 1_000_000, 20_000
_JOBS, _QUICK_JOBS = 100_000, 5_000
_CLIENTS = 50
_PAUSE_S = 5.0
"""As somebody who looks at one page after the other."""
_SECONDS, _QUICK_SECONDS = 60.0, 10.0
_SIDE, _QUICK_SIDE = 2048, 256
_TILES = 3
_EVENTS = 20
_BETWEEN_EVENTS_S = (0.5, 1.5)
_HEARD_WITHIN_S = 30.0
_AT = datetime(2026, 1, 1, tzinfo=UTC)
_DRIFTED = 12
"""Calibrations that the page of drift compares."""
_DRIFT_MM, _PARAMETER_SIGMA = 0.01, 1e-4
"""From one calibration to the next; of each parameter, in its own unit."""


def _addresses(services: Services, fields: Sequence[int]) -> list[str]:
    """Return what people open and what programs ask for, of what is in the catalogue or is sealed here."""
    campaign = many_jobs.name_of(0)
    with_jobs = {"campaign": campaign, "limit": 50}
    waiting, queued = (
        jobs.list_jobs(services, campaign=campaign, states=[state], limit=1)[0].id
        for state in (JobState.WAITING, JobState.QUEUED)
    )
    questions = [many_files.DOCUMENTED[place] for place in (0, 1, 6, 8)]
    pages = [
        "/",
        "/campaigns",
        f"/campaigns/{campaign}",
        f"/jobs?{urlencode(with_jobs)}",
        f"/jobs?{urlencode({'states': 'queued'})}",
        f"/jobs/{waiting}",
        f"/archive?{urlencode({'query': questions[0]})}",
        f"/field/{fields[0]}",
        "/recordings",
        "/schedules",
        "/runs",
        "/calibrations",
    ]
    asked = [
        "/status",
        f"/jobs?{urlencode(with_jobs)}",
        f"/jobs?{urlencode(with_jobs | {'states': 'queued'})}",
        f"/campaigns/{campaign}/progress",
        *(f"/data/find?{urlencode({'query': text})}" for text in questions),
        "/calibrations",
        f"/jobs/{waiting}",
        f"/jobs/{queued}/explain",
    ]
    return [*pages, *(f"{API}{address}" for address in asked)]


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


def _calibrations(services: Services) -> None:
    """Seal what the newest calibrations of the rig of a million files are: each has drifted a little more.

    Each has the covariance of its parameters, as one that was certified has; a page compares them.
    """
    with services.catalogue.reading() as session:
        newest = search.list_calibrations(session, many_files.RIG, _DRIFTED)[::-1]
    known, _ = small_plate("drift")
    count = len(known.rig.sensors) * len(SENSOR_PARAMETERS)
    covariance = np.diag(np.full(count, _PARAMETER_SIGMA**2))
    names = tuple(sensor.name for sensor in known.rig.sensors)
    uncertainty = CalibrationUncertainty(names, SENSOR_PARAMETERS, covariance)
    for place, view in enumerate(newest):
        sensors = tuple(_shifted(sensor, _DRIFT_MM * place * k) for k, sensor in enumerate(known.rig.sensors))
        record = replace(known, rig=replace(known.rig, name=many_files.RIG, sensors=sensors))
        made = Provenance(
            CALIBRATION, 1, Subject("drift"), "drift", place + 1, _AT, {}, (), "0", "here", "me"
        )
        records = {CALIBRATED.stored_as: record, UNCERTAINTY.stored_as: uncertainty}
        sealed = services.archive.seal_dataset(records, made)
        with services.catalogue.writing() as session:
            row = session.get_one(CalibrationRow, view.id)
            row.valid_from = many_files.BEGUN + timedelta(days=1 + place)
            file = session.get_one(FileRow, row.file_id)
            file.path, file.content_hash = sealed.path, sealed.content_hash
            file.size_bytes, file.sha256 = sealed.size_bytes, sealed.sha256


def _shifted(sensor: Sensor, by_mm: float) -> Sensor:
    """Return a sensor that stands beside where it stood."""
    x, y, z = sensor.pose.translation
    return replace(sensor, pose=replace(sensor.pose, translation=(x + by_mm, y, z)))


def _first_tiles(web: Served, numbers: Sequence[int]) -> list[float]:
    """Return the ms until somebody who opens the page of a field has its first picture."""
    taken = []
    with httpx2.Client(base_url=web.url, timeout=60.0) as client:
        for number in numbers:
            began = time.perf_counter()
            client.get(f"/fields/{number}/first.png").raise_for_status()
            taken.append(1e3 * (time.perf_counter() - began))
    return taken


@dataclass(frozen=True)
class _Delays:
    """ms from a committed change of a job to whoever hears events, and to a page that shows it."""

    to_stream: list[float]
    to_page: list[float]


def _event_delays(services: Services, web: Served, folder: Path, program: str | None) -> _Delays:
    """Cancel jobs that a page lists, one now and then, and return when each was told and shown."""
    listed = [job for job in jobs.list_jobs(services, limit=LISTED) if job.state == JobState.QUEUED.value]
    chance = random.Random(1)  # noqa: S311 - the same pauses every time
    found = _Delays([], [])
    with EventEar(web.url) as ear, PageOfJobs(web.site, ear, folder, program) as page:
        time.sleep(1.0)  # until it listens
        for job in listed[:_EVENTS]:
            jobs.cancel(services, [job.id], None)
            told, committed = time.perf_counter(), time.time()
            shown = page.shown_at(job.id, _HEARD_WITHIN_S)
            found.to_page.append(1e3 * max(shown - committed, 0.0))
            found.to_stream.append(1e3 * max(ear.heard_at(job.id, _HEARD_WITHIN_S) - told, 0.0))
            time.sleep(chance.uniform(*_BETWEEN_EVENTS_S))
    return found


def _slowest(taken: dict[str, list[float]]) -> str:
    """Return the addresses by their median, the slowest first."""
    middle = {address: median(times) for address, times in taken.items() if times}
    ordered = sorted(middle, key=lambda address: -middle[address])
    return "; ".join(f"{address.partition('?')[0]} {middle[address]:.0f} ms" for address in ordered[:4])


def _number_of_pages(addresses: Sequence[str]) -> int:
    return sum(not address.startswith(API) for address in addresses)


def _shown_by(program: str | None) -> str:
    """Return what the delay of events is measured to."""
    if program is not None:
        return "the page of jobs in Chromium"
    return "a client that reads events and the page of jobs as the page's script does (there is no Chromium)"


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
    numbers = _fields(services, side)
    _calibrations(services)
    addresses, program = _addresses(services, numbers), find_browser()
    seconds = _QUICK_SECONDS if run.quick else _SECONDS
    with served(home) as web:
        run.say("web: first tiles of fields")
        tile = median(_first_tiles(web, numbers))
        run.say(f"web: {_CLIENTS} clients")
        with httpx2.Client(base_url=web.site, timeout=60.0) as client:
            for address in addresses:  # what is loaded once does not count
                client.get(address).raise_for_status()
        taken = crowd(web.site, addresses, _CLIENTS, _PAUSE_S, seconds)
        every = [ms for times in taken.values() for ms in times]
        rss = web.rss_mb
        run.say("web: events")
        delays = _event_delays(services, web, home / "profile", program)
    p95 = quantiles(every, n=20)[-1]
    whole = None if run.quick else 1.0
    yield Figure("p95_ms", whole and p95, "ms", 100.0, "at most")
    yield Figure("first_tile_ms", whole and tile, "ms", 200.0, "at most")
    yield Figure("event_delay_ms", whole and quantiles(delays.to_page, n=20)[-1], "ms", 500.0, "at most")
    yield Figure("rss_mb", whole and rss, "MB", 300.0, "at most")
    yield Condition(
        "p95",
        f"{filled}, on SQLite; {_CLIENTS} clients of one 'sms serve' on this machine, each of which asks, "
        f"gets its answer, and pauses {_PAUSE_S:g} s, for {seconds:g} s; {len(every)} answers to "
        f"{len(addresses)} addresses in equal parts, {_number_of_pages(addresses)} of them pages as people "
        f"open them: median {median(every):.0f} ms, 95 % within "
        f"{p95:.0f} ms; slowest by median: {_slowest(taken)}",
    )
    yield Condition(
        "first_tile",
        f"the picture that the page of a field of {side} x {side} px in float64 shows first, of a file that "
        f"this process never read: {tile:.0f} ms, median of {_TILES}; files in the system's cache",
    )
    yield Condition(
        "event_delay",
        f"from the return of the commit that cancels a job to the frame in which {_shown_by(program)} shows "
        f"it, 95 % of {len(delays.to_page)} jobs, one every second or so; median "
        f"{median(delays.to_page):.0f} ms, of which {median(delays.to_stream):.0f} ms to a client of /events",
    )
    yield Condition(
        "rss",
        f"of the process that serves, after these clients: {rss:.0f} MB; calibrations were compared in "
        "another one, which has ended",
    )


GROUP = Group("web", "the interface over HTTP", lambda: None, measure)
