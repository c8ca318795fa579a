"""Asks the package registry whether a version of a lock is known to be vulnerable.

Where the registry does not answer, or knows none of the packages, that is said and nothing is wrong.
Exit code 1 means that a vulnerability is known.

    .venv/bin/python ops/audit.py requirements-test.lock
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

LONGEST_S = 120.0
ANSWERS_WITHIN_S = 5


def asked(lock: Path) -> tuple[dict[str, Any] | None, str]:
    """Return what the registry says of the packages of a lock, or None and why it says nothing."""
    with TemporaryDirectory() as folder:
        answer = Path(folder) / "audit.json"
        command = [
            *(sys.executable, "-m", "pip_audit", "--requirement", str(lock), "--require-hashes"),
            *("--disable-pip", "--progress-spinner", "off", "--timeout", str(ANSWERS_WITHIN_S)),
            *("--format", "json", "--output", str(answer)),
        ]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S, check=False)
        except subprocess.TimeoutExpired:
            return None, f"it did not answer within {LONGEST_S:g} s"
        if answer.is_file() and answer.stat().st_size:
            told: dict[str, Any] = json.loads(answer.read_text(encoding="utf-8"))
            return told, ""
    lines = done.stderr.strip().splitlines()
    return None, lines[-1] if lines else f"pip-audit ended with exit code {done.returncode}"


def verdict(told: dict[str, Any]) -> tuple[bool, list[str]]:
    """Return whether nothing is known against any package, and lines that say what is known."""
    packages = told["dependencies"]
    known = [one for one in packages if "vulns" in one]
    lines = [
        f"{one['name']} {one['version']}: {found['id']}, fixed in {', '.join(found['fix_versions']) or '-'}"
        for one in known
        for found in one["vulns"]
    ]
    if not known:
        return True, [f"audit skipped: the registry knows nothing of any of {len(packages)} packages"]
    if lines:
        return False, [*lines, "run 'bash ops/lock.sh', or say in the lock's ADR why it does no harm"]
    unknown = len(packages) - len(known)
    rest = f"; of {unknown} others the registry knows nothing" if unknown else ""
    return True, [f"nothing is known against {len(known)} packages{rest}"]


def main(lock: Path) -> int:
    """Ask, say what came of it, and return the exit code."""
    told, why = asked(lock)
    good, lines = (True, [f"audit skipped: {why}"]) if told is None else verdict(told)
    sys.stderr.write("".join(f"{line}\n" for line in lines))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
