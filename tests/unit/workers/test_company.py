"""A process that lives without children is noticed, with real processes."""

from __future__ import annotations

import subprocess
import sys
import time

import psutil

from sms_jobs.workers.supervisor import Company

PARENT = """
import subprocess, sys
child = subprocess.Popen(["sleep", "60"])
print(child.pid, flush=True)
sys.stdin.read()
"""


def test_time_runs_from_the_last_child_on() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        company = Company(parent.pid, 0.0)
        assert company.missed_s(10.0) == 0.0
        # Killed and not waited for by its parent, it is a zombie: no company.
        child.kill()
        while child.status() != psutil.STATUS_ZOMBIE:
            time.sleep(0.01)
        assert company.missed_s(15.0) == 5.0
        parent.kill()
    assert company.missed_s(20.0) == 10.0
