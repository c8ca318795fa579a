"""The group `web`: it measures a real server, and a small catalogue is no figure of a large one."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path

import pytest
from support.browser import browser_or_skip

from sms_jobs.bench import web_clients
from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.groups import all_groups, web


@pytest.mark.parametrize("browser", [True, False], ids=["in a browser", "without one"])
def test_a_small_server_is_measured_and_gives_no_figure(
    home: Path, monkeypatch: pytest.MonkeyPatch, browser: bool
) -> None:
    if browser:
        browser_or_skip()
    if not browser:
        monkeypatch.setenv("SMS_TEST_BROWSER", "none")
    few = {"_QUICK_JOBS": 400, "_QUICK_SECONDS": 2.0, "_PAUSE_S": 1.0, "_EVENTS": 3}
    for name, value in few.items():
        monkeypatch.setattr(web, name, value)
    told: list[str] = []
    found = list(all_groups()["web"].measure(Run(True, told.append, 1, home)))
    figures = {f.name: f for f in found if isinstance(f, Figure)}
    assert {n: f.target for n, f in figures.items()} == {
        "p95_ms": 100.0,
        "first_tile_ms": 200.0,
        "event_delay_ms": 500.0,
        "rss_mb": 300.0,
    }
    assert all(f.value is None for f in figures.values())
    conditions = {c.topic: c.text for c in found if isinstance(c, Condition)}
    assert conditions["p95"].startswith("20000 files and 400 jobs that have not ended, on SQLite; 50 clients")
    assert " answers to 23 addresses in equal parts, 12 of them pages" in conditions["p95"]
    assert ("the page of jobs in Chromium" in conditions["event_delay"]) is browser
    assert ("there is no Chromium" in conditions["event_delay"]) is not browser
    assert "95 % of 3 jobs" in conditions["event_delay"]
    # The page is fetched after the event was heard.
    to_page, to_stream = map(int, re.findall(r"(\d+) ms", conditions["event_delay"])[-2:])
    assert to_page >= to_stream


def test_a_client_that_stands_for_a_page_waits_as_long_as_its_script() -> None:
    script = files("sms_jobs.web").joinpath("static/live.js").read_text(encoding="utf-8")
    gathered = re.search(r"GATHERED_MS = (\d+)", script)
    assert gathered is not None
    assert int(gathered[1]) == 1e3 * web_clients.GATHERED_S
