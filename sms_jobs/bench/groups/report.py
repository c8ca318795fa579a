"""The report of a long test: how large its page is, how soon it opens, and what writing it takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

from sms_jobs.bench.browser import Browser, find_browser
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.large import long_campaign

_STATES, _QUICK_STATES = 300, 20
_SIZE, _QUICK_SIZE = (2048, 2448), (512, 612)
_MOST_MB, _OPEN_S = 60.0, 3.0
_OPENED = 3
_FIRST = "section.view"
_DRAWN = f"document.querySelector('{_FIRST} .readout')?.textContent.length > 0"
_ANSWERED = f"document.querySelector('{_FIRST} .readout').textContent.includes(' at x ')"


def opening(program: str, page: Path, profile: Path) -> tuple[float, float]:
    """Return the time and the CPU time in s until a page that a new browser opens answers.

    From when the browser, which has never been run before, is told to open the file, until the first map of
    the first chapter is drawn in sight and a click on it has been answered with the value there. The CPU time
    is that of all processes of the browser.
    """
    with Browser(program, profile) as browser:
        started, used = time.perf_counter(), browser.cpu_seconds()
        browser.open(page)
        browser.run(f"document.querySelector('{_FIRST}').scrollIntoView()")
        browser.wait_for(_DRAWN)
        browser.click(f"{_FIRST} canvas")
        browser.wait_for(_ANSWERED)
        return time.perf_counter() - started, browser.cpu_seconds() - used


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    states, size = (_QUICK_STATES, _QUICK_SIZE) if run.quick else (_STATES, _SIZE)
    run.say(f"report: sealing results of {size[1]} x {size[0]} px")
    long_campaign.seal(run.folder, long_campaign.long_test(states), size)
    run.say(f"report: writing the page of {states} states")
    taken = long_campaign.measure(run.folder, states)
    page = Path(taken.page)
    yield Figure("states_300_mb", page.stat().st_size / 1e6, "MB", _MOST_MB, "at most")
    yield from _opened(run, page)
    yield Figure("states_300_write_cpu_s", taken.cpu_s, "s")
    yield Figure("states_300_rss_mb", taken.peak_rss_mb, "MB")
    shrunk = f"shrunk to {states} states by --quick; " if run.quick else ""
    yield Condition(
        "states_300",
        f"{shrunk}{states} deformed states and the reference, one view of two cameras of "
        f"{size[1]} x {size[0]} px, results as merge and strain make them, with noise that goes together "
        f"over subsets of {long_campaign.SUBSET_PX} px and gauges of {long_campaign.GAUGE_PX} px; "
        f"{long_campaign.SEALED} of each are sealed, and every state reads one of them and multiplies it by "
        "its own load; default parameters; CPU time and peak memory of the writing process alone, in MB of "
        "10^6 bytes",
    )


def _opened(run: Run, page: Path) -> Iterator[Found]:
    program = find_browser()
    if program is None:
        yield Figure("states_300_open_s", None, "s", _OPEN_S, "at most")
        yield Condition("states_300_open", "left out: there is no Chromium, or SMS_TEST_BROWSER is 'none'")
        return
    run.say("report: opening the page")
    times = [opening(program, page, run.folder / f"profile{place}") for place in range(_OPENED)]
    yield Figure("states_300_open_s", median(wall for wall, _ in times), "s", _OPEN_S, "at most")
    yield Figure("states_300_open_cpu_s", median(cpu for _, cpu in times), "s")
    yield Condition(
        "states_300_open",
        f"median of {_OPENED} headless Chromium without a graphics card, each with a new profile, from "
        "file://: from when it is told to open the page until the first map of the first chapter is drawn "
        "in sight and a click on it is answered with the value there; wall time, which a busy machine "
        "lengthens, and CPU time of all its processes; the file is in the system's cache",
    )


GROUP = Group("report", "size of a report of 300 states, and how soon it opens", lambda: None, measure)
