"""The group `web`: it measures a real server, and a small catalogue is no figure of a large one."""

from __future__ import annotations

from pathlib import Path

import pytest

from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.groups import all_groups, web


def test_a_small_server_is_measured_and_gives_no_figure(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"_QUICK_JOBS": 400, "_QUICK_SECONDS": 2.0, "_PAUSE_S": 1.0}.items():
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
    assert " answers to 11 addresses" in conditions["p95"]
