"""Whoever asks which job kinds there are does without the libraries that few of their functions need."""

from __future__ import annotations

import subprocess
import sys

import pytest

NEEDED_BY_FEW = ("cv2", "matplotlib", "scipy.interpolate", "scipy.optimize")


@pytest.mark.parametrize(
    ("module", "expected"),
    [("sms_jobs.kinds", ()), ("sms_jobs.workers.place", ("cv2", "scipy.optimize"))],
    ids=["everybody", "a place that is forked"],
)
def test_what_all_kinds_load(module: str, expected: tuple[str, ...]) -> None:
    asked = (
        f"import sys, {module}\nfrom sms_jobs.kinds import all_kinds\nassert all_kinds()\n"
        f"print(*(name for name in {NEEDED_BY_FEW} if name in sys.modules))\n"
        "assert 'scipy.stats' not in sys.modules, 'half a second of every start: take scipy.special'"
    )
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert set(expected) <= set(done.stdout.split())
    if not expected:
        assert done.stdout.split() == []
