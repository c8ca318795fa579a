"""What cannot be printed, on a full disk or where nobody listens, ends in one sentence."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from support.command import SMS
from support.homes import make_home

from sms_jobs.errors import StorageUnusable

FULL = Path("/dev/full")
COMMANDS = (
    ("--help",),
    ("--version",),
    ("status",),
    ("status", "--json"),
    ("campaign", "list"),
    ("data", "find", "--json"),
    ("campaign", "create", "--example"),
)


@pytest.fixture(scope="module")
def used(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a campaign in it."""
    home = tmp_path_factory.mktemp("used") / "home"
    make_home(home, {})
    return home


def run(home: Path, arguments: tuple[str, ...], stdout: int, stderr: int) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*SMS, *arguments],
        stdout=stdout,
        stderr=stderr,
        text=True,
        env=os.environ | {"SMS_HOME": str(home)},
        stdin=subprocess.DEVNULL,
        timeout=60,
        check=False,
    )


@pytest.mark.skipif(not FULL.exists(), reason="this system has no device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_an_answer_that_finds_no_room_is_told_in_one_sentence(
    used: Path, arguments: tuple[str, ...], unbuffered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    with FULL.open("w") as full:
        done = run(used, arguments, full.fileno(), subprocess.PIPE)
        assert done.returncode == StorageUnusable.exit_code
        (line,) = done.stderr.splitlines()
        assert line.startswith(
            "error: the answer cannot be written to standard output: No space left on device"
        )


@pytest.mark.skipif(not FULL.exists(), reason="this system has no device that is always full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_where_the_sentence_finds_no_room_either_the_exit_code_tells(
    used: Path, unbuffered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    with FULL.open("w") as full:
        done = run(used, ("status",), full.fileno(), full.fileno())
    assert done.returncode == StorageUnusable.exit_code


def test_a_command_whose_output_is_closed_does_its_work(used: Path) -> None:
    closed = " ".join([*SMS, "queue", "pause", "cpu", "--reason", "quiet", ">&-", "2>&-"])
    done = subprocess.run(
        ["bash", "-c", closed], env=os.environ | {"SMS_HOME": str(used)}, timeout=60, check=False
    )
    assert done.returncode == 0
    shown = run(used, ("queue", "list"), subprocess.PIPE, subprocess.PIPE)
    assert "quiet" in shown.stdout
