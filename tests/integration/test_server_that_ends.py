"""A server that ends while somebody listens to events: it says so, and waits for nobody."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import httpx2
from support.serving import serving

from sms_jobs import bootstrap


def test_who_listens_is_told_that_the_server_ends(tmp_path: Path) -> None:
    bootstrap.initialise(tmp_path / "home")
    with ExitStack() as listening:
        with serving(tmp_path / "home") as address:
            answer = listening.enter_context(httpx2.stream("GET", f"{address}/api/v1/events", timeout=30.0))
            lines = answer.iter_lines()
            assert next(lines).startswith(":")
        assert list(lines) == [""]  # a connection that is cut raises an error
