"""How much memory a process has needed at most."""

from __future__ import annotations

import resource
import sys
from pathlib import Path


def peak_rss_mb() -> float:
    """Return the most memory that this process has held, in MB (10^6 bytes)."""
    status = Path("/proc/self/status")
    if status.is_file():
        # Unlike `getrusage`, it does not count the parent's memory before this program was started.
        for line in status.read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) * 1024 / 1e6
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
