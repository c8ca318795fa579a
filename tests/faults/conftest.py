"""What faults are made with."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.missing import do_without
from support.servers import PostgresqlServer, postgresql_programs


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MB; only who may mount one gets it."""
    folder = tmp_path / "small-disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "none", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a small file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PostgresqlServer]:
    """A PostgreSQL server of this test alone."""
    programs = postgresql_programs()
    if programs is None:
        do_without("needs PostgreSQL to start a server of its own: install it, or run ops/test.sh")
    folder = Path(tempfile.gettempdir()) / f"sms-place-{os.getpid()}"
    server = PostgresqlServer(folder, programs)
    try:
        yield server
    finally:
        server.crash()
        shutil.rmtree(folder)
