"""The audit of dependencies fails for what is known, and for nothing else."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support.servers import free_port

ROOT = Path(__file__).resolve().parents[2]
AUDIT = ROOT / "ops" / "audit.py"

KNOWN = {"name": "rich", "version": "15.0.0", "vulns": []}
BAD = {"name": "celery", "version": "1.0", "vulns": [{"id": "PYSEC-1", "fix_versions": ["1.1", "2.0"]}]}
UNKNOWN = {"name": "vtk", "skip_reason": "Dependency not found on PyPI"}


@pytest.mark.parametrize(
    ("packages", "good", "words"),
    [
        ([KNOWN, KNOWN], True, "nothing is known against 2 packages"),
        (
            [KNOWN, UNKNOWN],
            True,
            "nothing is known against 1 packages; of 1 others the registry knows nothing",
        ),
        ([UNKNOWN], True, "audit skipped: the registry knows nothing of any of 1 packages"),
        ([KNOWN, BAD, UNKNOWN], False, "celery 1.0: PYSEC-1, fixed in 1.1, 2.0"),
    ],
)
def test_what_is_known_decides(packages: list[dict[str, Any]], good: bool, words: str) -> None:
    found, lines = runpy.run_path(str(AUDIT))["verdict"]({"dependencies": packages})
    assert (found, lines[0]) == (good, words)


def test_a_registry_that_does_not_answer_is_said_and_passed(tmp_path: Path) -> None:
    lock = tmp_path / "one.lock"
    lock.write_text(f"rich==15.0.0 --hash=sha256:{'0' * 64}\n")
    nobody = f"http://127.0.0.1:{free_port()}"
    asked = subprocess.run(
        [sys.executable, AUDIT, lock],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"HTTPS_PROXY": nobody, "HTTP_PROXY": nobody, "NO_PROXY": "", "HOME": str(tmp_path)},
    )
    assert asked.returncode == 0, asked.stderr
    assert "audit skipped: " in asked.stderr
