"""`sms doctor`: what is wrong with a home, and what to do about it."""

from __future__ import annotations

import typer

from sms_jobs.app.doctor import Examined, diagnosed
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json

_FINDINGS = 6


def doctor(home: Home = None, as_json: Json = False) -> None:
    """Check catalogue, archive, messages, workers, clock and disk; say what to do about each finding.

    Example: sms doctor
    """
    with diagnosed(home) as found:
        checks = [one for name, examined in found.items() for one in _rows(name, examined)]
    bad = any(finding for _, finding, _ in checks)
    if as_json:
        shown = [{"check": name, "finding": finding or "ok", "found": what} for name, finding, what in checks]
        output.print_json({"healthy": not bad, "checks": shown})
    else:
        rows = [(name, finding or f"ok{what and ': '}{what}") for name, finding, what in checks]
        output.print_table(["check", "finding"], rows, empty="")
    if bad:
        raise typer.Exit(_FINDINGS)


def _rows(name: str, examined: Examined) -> list[tuple[str, str, str]]:
    return [(name, finding, examined.what) for finding in examined.findings or ("",)]
