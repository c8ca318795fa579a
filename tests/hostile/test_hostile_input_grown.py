"""No command line and no file ends in an internal error, on PostgreSQL: see `sms_jobs.bench.hostile`."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.hostile import LONG_BATCHES, SHORT_BATCHES, assert_well


@pytest.mark.postgresql
def test_hostile_input_on_postgresql(tmp_path: Path, postgresql_url: str) -> None:
    assert_well(tmp_path, "grown", SHORT_BATCHES["grown"])


@pytest.mark.long
@pytest.mark.postgresql
def test_much_hostile_input_on_postgresql(tmp_path: Path, postgresql_url: str) -> None:
    assert_well(tmp_path, "grown", LONG_BATCHES)
