"""The catalogue: how long the documented queries take among a million files, on both databases."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from statistics import median

from sms_jobs.bench import large_catalogue
from sms_jobs.bench.figures import REPEATS, Condition, Figure, Found, Group, Run
from sms_jobs.bench.servers import POSTGRESQL, fresh_postgresql
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.finding import find_page
from sms_jobs.catalogue.query_fields import Vocabulary
from sms_jobs.catalogue.query_language import parse

_FILES, _QUICK_FILES = 1_000_000, 20_000
_TARGET_MS = 10.0


def _measured(url: str, files: int, run: Run) -> dict[str, float]:
    """Return the median milliseconds of each documented query."""
    kinds = frozenset({*large_catalogue.KINDS, "calibration"})
    known = Vocabulary(lambda: (kinds, large_catalogue.PARAMETERS))
    taken = {}
    with closing(Catalogue(url, create=True)) as catalogue:
        schema.upgrade(catalogue)
        large_catalogue.fill(catalogue, files, lambda text: run.say(f"catalogue: {text}"))
        if catalogue.dialect == "postgresql":
            # As its autovacuum does by itself after so many rows: before, no index answers alone.
            with catalogue.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                connection.exec_driver_sql("VACUUM")
        for text in large_catalogue.DOCUMENTED:
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
    files = _QUICK_FILES if run.quick else _FILES
    with fresh_postgresql() as server:
        urls = {"": f"sqlite:///{run.folder / 'catalogue.sqlite'}", "_postgresql": server}
        for name, url in urls.items():
            if url is None:
                yield Figure(f"find_1m_rows{name}_ms", None, "ms", _TARGET_MS, "at most")
                yield Condition(f"find_1m_rows{name}", f"left out: no server in {POSTGRESQL}")
                continue
            taken = _measured(url, files, run)
            slowest = max(taken, key=lambda text: taken[text])
            middle = median(taken.values())
            yield Figure(f"find_1m_rows{name}_ms", None if run.quick else middle, "ms", _TARGET_MS, "at most")
            yield Figure(f"find_1m_rows{name}_slowest_ms", None if run.quick else taken[slowest], "ms")
            yield Condition(
                f"find_1m_rows{name}",
                f"{files} files with 1 to 3 statistics each and a job, ANALYZE done, and VACUUM on "
                f"PostgreSQL; wall time from the text to 50 files with the values asked for, median of "
                f"{REPEATS} after one that does not count, over {len(taken)} queries of docs/query.md: "
                f"{middle:.1f} ms; slowest {taken[slowest]:.1f} ms: {slowest}",
            )


GROUP = Group("catalogue", "queries among a million files", lambda: None, measure)
