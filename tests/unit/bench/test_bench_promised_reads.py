"""Damaged files are noticed by jobs and by whoever reads them: some of the tries of the bench."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from sms_jobs.bench.tampering import main, prepare, tried


def judged(told: Counter[str], tries: int) -> None:
    print(dict(told))
    # Of some bits nothing is read; they are few, since most of a file are values.
    assert told["noticed"] > 0.8 * tries
    assert told["noticed"] + told["same"] == tries


def test_no_altered_file_gives_other_values(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prepare(home)
    # In this process, since the tries are always the same and none of these makes HDF5 spin.
    main(home, "reads", 0, 60)
    main(home, "jobs", 0, 4)
    judged(Counter(capsys.readouterr().out.split()), 64)


@pytest.mark.long
def test_none_of_ten_thousand_altered_files_gives_other_values(home: Path) -> None:
    prepare(home)
    judged(Counter(tried(home, "reads", 9_800)) + Counter(tried(home, "jobs", 200)), 10_000)
