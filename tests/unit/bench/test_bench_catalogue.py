"""The group `catalogue`: a small catalogue is asked all its questions, and gives no figure of a large one."""

from __future__ import annotations

from pathlib import Path

import pytest

from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.groups import catalogue
from sms_jobs.bench.large.questions import QUESTIONS
from sms_jobs.bench.servers import POSTGRESQL


def test_a_small_catalogue_is_asked_and_gives_no_figure(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(POSTGRESQL, raising=False)
    for name, value in {"_QUICK_JOBS": 800, "_QUICK_CALLS": 11}.items():
        monkeypatch.setattr(catalogue, name, value)
    home.mkdir(exist_ok=True)
    found = list(catalogue.GROUP.measure(Run(True, lambda text: None, 1, home)))
    figures = {f.name: f for f in found if isinstance(f, Figure)}
    assert all(f.value is None for f in figures.values())
    assert {f"{question}_{what}" for question in QUESTIONS for what in ("p95_ms", "rss_mb")} < set(figures)
    conditions = {c.topic: c.text for c in found if isinstance(c, Condition)}
    for question in QUESTIONS:
        # Thirteen of files, and as many as eight hundred jobs come to.
        assert "17 campaigns, 20000 files whose jobs have succeeded, 800 that" in conditions[question]
    assert conditions["find_1m_rows"].startswith("20000 files")
    assert conditions["find_1m_rows_postgresql"] == f"left out: no server in {POSTGRESQL}"
