"""Tries in a process of their own, whatever the one that asks for them has loaded or started."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, TypeAlias

from sms_jobs.bench.hostile.trial import Outcome

Deployment: TypeAlias = Literal["embedded", "grown"]


def tried(folder: Path, deployment: Deployment, seed: int, batches: range) -> Iterator[Outcome]:
    """Try batches of command lines on homes in an empty folder; the same seed gives the same command lines.

    Raises `RuntimeError` when the trial itself breaks off.
    """
    command = [sys.executable, "-P", "-m", __package__, str(folder), deployment]
    command += [str(number) for number in (seed, batches.start, batches.stop)]
    with (folder / "trial.log").open("w+b") as log:
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log
        ) as process:
            assert process.stdout is not None
            for line in process.stdout:
                outcome = json.loads(line)
                yield Outcome(
                    **outcome | {"arguments": tuple(outcome["arguments"]), "faults": tuple(outcome["faults"])}
                )
        if process.returncode != 0:
            log.seek(0)
            raise RuntimeError(f"the trial broke off: {log.read()[-2000:].decode(errors='replace')}")
