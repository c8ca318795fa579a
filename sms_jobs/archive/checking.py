"""Checking a dataset file in a process of its own, with a time limit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from sms_jobs.archive.dataset import check_dataset
from sms_jobs.errors import ArchiveCorrupt, FormatTooNew

START_SECONDS = 60.0
BYTES_PER_SECOND = 5e6
"""Slower than any disk that is worth keeping data on."""

_CHECK = (
    "import sys; from sms_jobs.archive.checking import check_and_tell; "
    "sys.exit(check_and_tell(*sys.argv[1:]))"
)


def check_and_tell(file: str, where: str, content_hash: str) -> int:
    """Check a file, write what is wrong to standard output, and return an exit code."""
    try:
        check_dataset(Path(file), where, content_hash)
    except (ArchiveCorrupt, FormatTooNew) as error:
        sys.stdout.write(str(error))
        return error.exit_code
    return 0


def check_apart(file: Path, where: str, content_hash: str) -> None:
    """Check a dataset file as `check_dataset` does, in a process of its own.

    Raises
    ------
    ArchiveCorrupt
        When the file does not have that content hash, or the check crashed or never ended.
    FormatTooNew
        When it was written by a newer version.
    """
    if not file.is_file():
        raise ArchiveCorrupt(f"{where} is missing from the archive; restore it from a backup")
    limit = START_SECONDS + file.stat().st_size / BYTES_PER_SECOND
    try:
        done = subprocess.run(
            [sys.executable, "-c", _CHECK, str(file), where, content_hash],
            capture_output=True,
            text=True,
            timeout=limit,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise ArchiveCorrupt(
            f"reading {where} did not end within {limit:.0f} s; restore it from a backup"
        ) from error
    if done.returncode == FormatTooNew.exit_code:
        raise FormatTooNew(done.stdout)
    if done.returncode == ArchiveCorrupt.exit_code:
        raise ArchiveCorrupt(done.stdout)
    if done.returncode != 0:
        raise ArchiveCorrupt(
            f"reading {where} ended with code {done.returncode} ({done.stderr.strip()[-200:]}); "
            "restore it from a backup"
        )
