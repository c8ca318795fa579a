"""Tries batches of command lines, and prints what came of each as a line of JSON.

python -m sms_jobs.bench.hostile FOLDER embedded|grown SEED FIRST LAST
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

from sms_jobs.bench.hostile import store, trial


def _main(folder: Path, deployment: str, seed: int, batches: range) -> int:
    for name in list(os.environ):
        if name.startswith("SMS_") and not name.startswith("SMS_TEST_"):
            del os.environ[name]
    os.environ["COLUMNS"] = "200"
    first = folder / "first"
    # In a process of its own: this one is to be forked, and must not have started any thread.
    child = os.fork()
    if child == 0:
        store.make_first(first)
        os._exit(0)
    if os.waitpid(child, 0)[1] != 0:
        return 1
    with store.opened(deployment, first) as homes:
        for outcome in trial.run(homes, folder, seed, batches):
            sys.stdout.write(json.dumps(asdict(outcome)) + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(
        _main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), range(int(sys.argv[4]), int(sys.argv[5])))
    )
