"""An account that may read catalogue and archive, and write nothing, can read."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.homes import make_home

from sms_jobs import bootstrap

AS_ANOTHER = """
import encodings.ascii, json, os, sys
import sms_jobs.cli.main as entry
from sms_jobs.bench.hostile import trial
trial.load_everything()  # while the interpreter's own folder can be read
from sms_jobs.cli import output
if os.geteuid() == 0:
    os.setgroups([]); os.setgid(65534); os.setuid(65534)
for words in json.loads(sys.argv[1]):
    child = os.fork()
    if child == 0:
        sys.argv = ["sms", *words]
        try:
            entry.main()
        finally:
            sys.stdout.flush()
            os._exit(getattr(sys.exc_info()[1], "code", 0) or 0)
    print(json.dumps({"code": os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}), flush=True)
"""
READING = (
    ["status"],
    ["campaign", "list"],
    ["data", "find"],
    ["data", "show", "1"],
    ["job", "list"],
    ["queue", "list"],
)


def read_only(folder: Path) -> None:
    for place in sorted(folder.rglob("*"), reverse=True):
        place.chmod(0o555 if place.is_dir() else 0o444)
    folder.chmod(0o555)


def answers(home: Path, commands: list[list[str]]) -> list[str]:
    words = [[*command, "--home", str(home)] for command in commands]
    done = subprocess.run(
        [sys.executable, "-c", AS_ANOTHER, json.dumps(words)],
        capture_output=True,
        text=True,
        env={k: v for k, v in os.environ.items() if not k.startswith("SMS_")}
        | {"PYTHONDONTWRITEBYTECODE": "1"},
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [*done.stdout.splitlines(), done.stderr]


@pytest.fixture
def home() -> Iterator[Path]:
    """A home in a folder that other accounts can enter, as they cannot those of the tests."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        made = Path(folder) / "home"
        made.mkdir()
        make_home(made, {})
        yield made
        for place in (made, *(p for p in made.rglob("*") if p.is_dir())):
            place.chmod(0o755)


@pytest.mark.parametrize("open_elsewhere", [False, True])
def test_who_may_only_read_can_read(home: Path, open_elsewhere: bool) -> None:
    if open_elsewhere:
        with bootstrap.services(home) as services, services.catalogue.writing() as session:
            session.connection()
            read_only(home)
            told = answers(home, list(READING))
    else:
        read_only(home)
        told = answers(home, list(READING))
    assert told.count('{"code": 0}') == len(READING), told
    assert any("plate" in line for line in told)


@pytest.mark.parametrize("command", [["queue", "pause", "cpu"], ["up"]], ids=" ".join)
def test_who_may_only_read_is_told_so(home: Path, command: list[str]) -> None:
    (home / "messages" / "queue").mkdir(parents=True, exist_ok=True)
    (home / "messages" / "control").mkdir(exist_ok=True)
    read_only(home)
    told = answers(home, [command])
    assert '{"code": 4}' in told
    assert "may only read the catalogue" in told[-1]
