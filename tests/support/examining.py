"""What `sms doctor` says of a home."""

from __future__ import annotations

import json
from pathlib import Path

import typer
from typer.testing import CliRunner

from sms_jobs.cli import doctor as doctor_command

_APP = typer.Typer()
_APP.command()(doctor_command.doctor)


def doctor(home: Path) -> tuple[int, dict[str, str]]:
    """Run the command in this process; return its exit code and, by check, its findings, a line each."""
    done = CliRunner().invoke(_APP, ["--json", "--home", str(home)])
    found: dict[str, list[str]] = {}
    for check in json.loads(done.stdout.splitlines()[-1])["checks"]:
        found.setdefault(check["check"], []).append(check["finding"])
    return done.exit_code, {check: "\n".join(findings) for check, findings in found.items()}
