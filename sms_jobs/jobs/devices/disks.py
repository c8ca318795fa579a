"""Room on the disks that a host writes to: that of the archive, and that of its spool."""

from __future__ import annotations

import shutil
from pathlib import Path


def nearest(folder: Path) -> Path:
    """Return a folder, or the nearest above it that is there: it will be made on that disk."""
    return next(one for one in (folder, *folder.parents) if one.exists())


def free_bytes(folder: Path) -> int:
    """Return what is free on the disk of a folder that may not be there yet."""
    return shutil.disk_usage(nearest(folder)).free


def spool_free_bytes(spool: Path, archive: Path) -> int | None:
    """Return what is free on the disk of the spool; None where that is the disk of the archive."""
    if nearest(spool).stat().st_dev == nearest(archive).stat().st_dev:
        return None
    return free_bytes(spool)
