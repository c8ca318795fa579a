"""How long the kernels of some groups take to compile: measured in a process with no cache of kernels.

Run as `python -m sms_jobs.bench.compilation phase fdr`, which prints the seconds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from sms_jobs.bench.groups import group_named
from sms_jobs.errors import SmsError


def compile_seconds(groups: Sequence[str]) -> float:
    """Return the seconds that the kernels of some groups take to compile where nothing is compiled yet."""
    with tempfile.TemporaryDirectory(prefix="sms-kernels-") as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-P", "-m", __name__, *groups]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise SmsError(f"compiling the kernels of {' and '.join(groups)} failed: {reason[0]}")
    return float(done.stdout.split()[-1])


def main(groups: Sequence[str]) -> None:
    """Print how much longer the first call of every kernel takes than the second."""
    seconds = 0.0
    for name in groups:
        group = group_named(name)
        started = time.perf_counter()
        group.warm_up()
        between = time.perf_counter()
        group.warm_up()
        seconds += (between - started) - (time.perf_counter() - between)
    sys.stdout.write(f"{max(seconds, 0.0):.3f}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
