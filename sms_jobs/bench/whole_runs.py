"""What a command takes with all processes that it begets, whoever ends and outlives whom.

Run as `python -m sms_jobs.bench.whole_runs COMMAND..`, which prints seconds by the clock and CPU-seconds.
"""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sms_jobs.errors import SmsError

_PR_SET_CHILD_SUBREAPER = 36
"""Of Linux's `prctl`: what loses its parent becomes this process's child, and is counted with it."""


@dataclass(frozen=True)
class Taken:
    """What a command took, by the clock and of all processors."""

    wall_s: float
    cpu_s: float


def taken_by(command: Sequence[str], environment: Mapping[str, str]) -> Taken:
    """Run a command of this program to its end; raise `SmsError` where it fails."""
    whole = [sys.executable, "-P", "-m", __name__, *command]
    done = subprocess.run(whole, capture_output=True, text=True, env=dict(environment), check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise SmsError(f"'{' '.join(command)}' failed: {reason[0]}")
    wall_s, cpu_s = done.stdout.split()[-2:]
    return Taken(float(wall_s), float(cpu_s))


def main(command: Sequence[str]) -> int:
    """Run the command, wait for all that it leaves behind, and print what they took."""
    if ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        raise SmsError("this system does not count processes that outlive their parents; use Linux")
    began = time.monotonic()
    code = subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    wall_s = time.monotonic() - began
    while True:
        try:
            os.wait()
        except ChildProcessError:
            break
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    sys.stdout.write(f"{wall_s:.3f} {used.ru_utime + used.ru_stime:.3f}\n")
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
