"""The catalogue: how long what people ask of it takes among a million files, on both databases."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from statistics import median, quantiles

from sms_jobs import bootstrap
from sms_jobs.bench.figures import REPEATS, Condition, Figure, Found, Group, Run
from sms_jobs.bench.large import many_files, many_jobs
from sms_jobs.bench.large.questions import QUESTIONS, answers
from sms_jobs.bench.servers import POSTGRESQL, environment, fresh_postgresql
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.queries.fields import Vocabulary
from sms_jobs.catalogue.queries.files import find_page
from sms_jobs.catalogue.queries.language import parse
from sms_jobs.jobs.asking.standing import number_of_campaigns

_FILES, _QUICK_FILES = 1_000_000, 20_000
_TARGET_MS = 10.0
_JOBS, _QUICK_JOBS = 100_000, 4_000
_JOBS_EACH = 264
"""Of a campaign: with the campaigns of the files, these are a thousand."""
_CALLS, _QUICK_CALLS = 110, 11
_ANSWER_MS = 100.0
_ANSWER_MB = 200.0


def _filled(url: str, files: int, active: int, run: Run) -> int:
    """Fill the catalogue of a home; return how many campaigns it has."""

    def say(text: str) -> None:
        run.say(f"catalogue: {text}")

    with closing(Catalogue(url)) as catalogue:
        many_files.fill(catalogue, files, say)
        many_jobs.fill_queue(catalogue, active, datetime.now(UTC), say, each=_JOBS_EACH)
        if catalogue.dialect == "postgresql":
            # As its autovacuum does by itself after so many rows: before, no index answers alone.
            with catalogue.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                connection.exec_driver_sql("VACUUM")
        with catalogue.reading() as session:
            return number_of_campaigns(session)


def _found(url: str) -> dict[str, float]:
    """Return the median milliseconds of each documented query."""
    kinds = frozenset({*many_files.KINDS, "calibration"})
    known = Vocabulary(lambda: (kinds, many_files.PARAMETERS))
    taken = {}
    with closing(Catalogue(url)) as catalogue:
        for text in many_files.DOCUMENTED:
            found = []
            for _ in range(REPEATS + 1):
                started = time.perf_counter()
                with catalogue.reading() as session:
                    find_page(session, parse(text), known)
                found.append(1e3 * (time.perf_counter() - started))
            taken[text] = median(found[1:])
    return taken


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    with fresh_postgresql() as server:
        for name, url in {"": "", "_postgresql": server}.items():
            if url is None:
                yield Figure(f"find_1m_rows{name}_ms", None, "ms", _TARGET_MS, "at most")
                yield Condition(f"find_1m_rows{name}", f"left out: no server in {POSTGRESQL}")
                continue
            home = run.folder / f"catalogue{name}"
            home.mkdir()
            with environment({"SMS_DATABASE_URL": url} if url else {}):
                yield from _measured(run, home, name)


def _measured(run: Run, home: Path, name: str) -> Iterator[Found]:
    files, active = (_QUICK_FILES, _QUICK_JOBS) if run.quick else (_FILES, _JOBS)
    url = bootstrap.initialise(home).catalogue_url
    campaigns = _filled(url, files, active, run)
    taken = _found(url)
    slowest = max(taken, key=lambda text: taken[text])
    middle = median(taken.values())
    whole = None if run.quick else 1.0
    yield Figure(f"find_1m_rows{name}_ms", whole and middle, "ms", _TARGET_MS, "at most")
    yield Figure(f"find_1m_rows{name}_slowest_ms", whole and taken[slowest], "ms")
    yield Condition(
        f"find_1m_rows{name}",
        f"{files} files with 1 to 3 statistics each and a job, ANALYZE done, and VACUUM on "
        f"PostgreSQL; wall time from the text to 50 files with the values asked for, median of "
        f"{REPEATS} after one that does not count, over {len(taken)} queries of docs/query.md: "
        f"{middle:.1f} ms; slowest {taken[slowest]:.1f} ms: {slowest}",
    )
    calls = _QUICK_CALLS if run.quick else _CALLS
    for question, (what, _) in QUESTIONS.items():
        run.say(f"catalogue: {question}")
        got = answers(home, question, calls)
        p95 = quantiles(got.ms, n=20)[-1]
        yield Figure(f"{question}{name}_p95_ms", whole and p95, "ms", _ANSWER_MS, "at most")
        yield Figure(f"{question}{name}_rss_mb", whole and got.rss_mb, "MB", _ANSWER_MB, "at most")
        yield Condition(
            f"{question}{name}",
            f"{what}, by the use case and as JSON, {calls} calls in turn in a process of its own, after one "
            f"of each that does not count: 95 % within {p95:.1f} ms of wall time, median "
            f"{median(got.ms):.1f} ms; at most {got.rss_mb:.0f} MB of memory, the program's own among them; "
            f"{campaigns} campaigns, {files} files whose jobs have succeeded, {active} that have not",
        )


GROUP = Group("catalogue", "questions among a million files", lambda: None, measure)
