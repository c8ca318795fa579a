"""What a recording has kept so far."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.instruments.spool import Spooled


def complete_frames(home: Path, view: str) -> int:
    """Return how many complete frames of a view are in the spool of a home."""
    found = 0
    for path in (home / "spool").glob(f"*/{view}.*.frames"):
        with suppress(ArchiveCorrupt):  # it was made a moment ago, and has no header yet
            found += Spooled(path).complete
    return found
