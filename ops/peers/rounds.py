"""How a script measures round by round: once unasked, which compiles, then once for each line it is sent."""

import sys
import time


def answer(work) -> None:
    """Do the work and say the CPU-seconds of it, until the input ends."""
    for _ in _asked():
        used = time.process_time()
        work()
        used = time.process_time() - used
        sys.stdout.write(f"\ncpu_s {used:.6f}\n")
        sys.stdout.flush()


def _asked():
    yield
    yield from sys.stdin
