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
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        sys.argv = ["sms", *json.loads(line)]
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
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


class Reader:
    """A process of the other account, which has loaded all that commands need, and forks for each."""

    def __init__(self, process: subprocess.Popen[str], complaints: Path) -> None:
        self._process = process
        self._complaints = complaints

    def answers(self, home: Path, *commands: list[str]) -> list[str]:
        """Return the lines that commands print, an exit code after each, and last what they complain of."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        before, told = self._complaints.stat().st_size, list[str]()
        for command in commands:
            self._process.stdin.write(json.dumps([*command, "--home", str(home)]) + "\n")
            self._process.stdin.flush()
            for line in self._process.stdout:
                told.append(line.rstrip("\n"))
                if line.startswith('{"code"'):
                    break
        assert self._process.poll() is None, self._complaints.read_text()
        return [*told, self._complaints.read_bytes()[before:].decode()]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    complaints = tmp_path_factory.mktemp("reader") / "complaints.log"
    own = {k: v for k, v in os.environ.items() if not k.startswith("SMS_")} | {"PYTHONDONTWRITEBYTECODE": "1"}
    with (
        complaints.open("w") as log,
        subprocess.Popen(
            [sys.executable, "-c", AS_ANOTHER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            env=own,
        ) as process,
    ):
        try:
            yield Reader(process, complaints)
        finally:
            process.kill()


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
def test_who_may_only_read_can_read(home: Path, reader: Reader, open_elsewhere: bool) -> None:
    if open_elsewhere:
        with bootstrap.services(home) as services, services.catalogue.writing() as session:
            session.connection()
            read_only(home)
            told = reader.answers(home, *READING)
    else:
        read_only(home)
        told = reader.answers(home, *READING)
    assert told.count('{"code": 0}') == len(READING), told
    assert any("plate" in line for line in told)


@pytest.mark.parametrize("command", [["queue", "pause", "cpu"], ["up"]], ids=" ".join)
def test_who_may_only_read_is_told_so(home: Path, reader: Reader, command: list[str]) -> None:
    (home / "messages" / "queue").mkdir(parents=True, exist_ok=True)
    (home / "messages" / "control").mkdir(exist_ok=True)
    read_only(home)
    told = reader.answers(home, command)
    assert '{"code": 4}' in told
    assert "may only read the catalogue" in told[-1]
