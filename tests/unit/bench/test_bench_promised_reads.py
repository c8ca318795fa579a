"""Damaged files are noticed by jobs and by whoever reads them: some of the tries of the bench."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from sms_jobs.bench.tampering import prepare, tried


@pytest.mark.parametrize(("reads", "jobs"), [(120, 6), pytest.param(9_800, 200, marks=pytest.mark.long)])
def test_no_altered_file_gives_other_values(home: Path, reads: int, jobs: int) -> None:
    prepare(home)
    told = Counter(tried(home, "reads", reads)) + Counter(tried(home, "jobs", jobs))
    print(dict(told))
    # Of some bits nothing is read; they are few, since most of a file are values.
    assert told["noticed"] > 0.8 * (reads + jobs)
    assert told["noticed"] + told["same"] == reads + jobs
