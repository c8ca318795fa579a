"""Runs `sms`: as a person does, in a process of its own, or in this one where only its answer is wanted."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from types import FrameType
from typing import Any

import psutil
import pytest
from typer.testing import CliRunner

from sms_jobs.cli.app import app
from sms_jobs.cli.main import main

SMS = [sys.executable, "-P", "-W", "error::DeprecationWarning:sms_jobs", "-m", "sms_jobs.cli.main"]


def sms(
    *arguments: str, environment: Mapping[str, str] | None = None, timeout: float = 300.0
) -> subprocess.CompletedProcess[str]:
    """Run one command to its end."""
    return subprocess.run(
        [*SMS, *arguments],
        capture_output=True,
        text=True,
        timeout=timeout,
        env=os.environ | {"COLUMNS": "200"} | dict(environment or {}),
        stdin=subprocess.DEVNULL,
        check=False,
    )


def inside(
    *arguments: str, environment: Mapping[str, str] | None = None, timeout: float = 300.0, given: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run one command to its end in this process, as its entry point does: errors and exit code included.

    What is `given` stands on its standard input.
    """
    printed, told, code = io.StringIO(), io.StringIO(), 0
    with (
        pytest.MonkeyPatch.context() as patch,
        _within(timeout),
        redirect_stdout(printed),
        redirect_stderr(told),
    ):
        patch.setattr(sys, "argv", ["sms", *arguments])
        patch.setattr(sys, "stdin", io.StringIO(given))
        for name, value in {"COLUMNS": "200", **(environment or {})}.items():
            patch.setenv(name, value)
        try:
            main()
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 0
    return subprocess.CompletedProcess(arguments, code, printed.getvalue(), told.getvalue())


def answer(*arguments: str, environment: Mapping[str, str] | None = None, timeout: float = 300.0) -> Any:
    """Run a command that must succeed, and return the JSON it prints.

    It runs in this process: to start another costs more than most commands do.
    """
    with pytest.MonkeyPatch.context() as patch, _within(timeout):
        for name, value in {"COLUMNS": "200", **(environment or {})}.items():
            patch.setenv(name, value)
        done = CliRunner().invoke(app, [*arguments, "--json"])
    assert done.exit_code == 0, f"{arguments}: {done.stderr}{done.exception}"
    return json.loads(done.stdout.splitlines()[-1])


@contextmanager
def _within(seconds: float) -> Iterator[None]:
    """Fail where something takes longer, whatever it waits for."""

    def late(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"the command did not end within {seconds:.0f} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def service(
    home: Path, environment: Mapping[str, str] | None = None, *options: str
) -> Iterator[psutil.Process]:
    """Run `sms up` meanwhile; whatever is left of it afterwards is killed."""
    log = (home / "up.log").open("ab")
    process = subprocess.Popen(
        [*SMS, "up", *options, "--home", str(home)],
        env=os.environ | dict(environment or {}),
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
    )
    supervisor = psutil.Process(process.pid)
    try:
        yield supervisor
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=120)
    finally:
        log.close()
        if process.poll() is None:
            kill_all(supervisor)
            process.wait()


def kill_all(process: psutil.Process) -> None:
    """Kill a process and all below it, with no chance to tidy up."""
    for one in [*process.children(recursive=True), process]:
        try:
            one.kill()
        except psutil.NoSuchProcess:
            continue


def wait_until(condition: Any, timeout: float = 120.0) -> Any:
    """Return what `condition()` returns once it is true; fail when it does not become so in time.

    Asking takes a fifth of the time at most: what is waited for needs the same cores.
    """
    deadline = time.monotonic() + timeout
    while (asked := time.monotonic()) < deadline:
        found = condition()
        if found:
            return found
        time.sleep(max(0.05, 4.0 * (time.monotonic() - asked)))
    raise AssertionError(f"did not become true within {timeout} s")
