"""No command line and no file ends in an internal error, on SQLite: see `sms_jobs.bench.hostile`."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.hostile import LONG_BATCHES, SHORT_BATCHES, assert_well


def test_hostile_input_on_sqlite(tmp_path: Path) -> None:
    assert_well(tmp_path, "embedded", SHORT_BATCHES["embedded"])


@pytest.mark.long
def test_much_hostile_input_on_sqlite(tmp_path: Path) -> None:
    assert_well(tmp_path, "embedded", LONG_BATCHES)
