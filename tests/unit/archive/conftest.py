"""An empty archive, and one with a measurement in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.sealing import measurement, provenance

from sms_jobs.archive import Archive, FolderStore, Sealed


@pytest.fixture
def archive(tmp_path: Path) -> Archive:
    return Archive(FolderStore(tmp_path / "archive"))


@pytest.fixture
def sealed(archive: Archive) -> Sealed:
    return archive.seal_dataset({"measurement": measurement(np.random.default_rng(7))}, provenance())
