"""How well it is known that the archive is as it was sealed."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime


@dataclass(frozen=True)
class CheckedFiles:
    """The files of a campaign, or those of none.

    Attributes
    ----------
    campaign
        By name; empty for calibrations and decisions that belong to none.
    files, size_bytes
        All of them.
    due, due_bytes
        Those that were never compared, or not since so long that it is due.
    damaged
        Those that were not as they were sealed when they were last looked at.
    oldest, newest
        When they were compared: the one longest ago, and the last; None where none was.
    """

    campaign: str
    files: int
    size_bytes: int
    due: int
    due_bytes: int
    damaged: int
    oldest: datetime | None
    newest: datetime | None


@dataclass(frozen=True)
class DamagedFile:
    """A file that was not as it was sealed when it was last looked at.

    Attributes
    ----------
    problem, detail
        What was wrong: missing, corrupt or too-new, and a sentence.
    """

    file: int
    path: str
    checked_at: datetime
    problem: str
    detail: str


@dataclass(frozen=True)
class ArchiveState:
    """When the files of the archive were compared, which are due, and which are damaged.

    Attributes
    ----------
    due_days
        After so many days a comparison is due again.
    campaigns
        In order of name.
    damaged
        The first 1000 by number.
    """

    due_days: float
    campaigns: tuple[CheckedFiles, ...]
    damaged: tuple[DamagedFile, ...]

    @property
    def files(self) -> int:
        """Of the whole archive."""
        return sum(one.files for one in self.campaigns)

    @property
    def size_bytes(self) -> int:
        """Of all files."""
        return sum(one.size_bytes for one in self.campaigns)

    @property
    def due(self) -> int:
        """How many files are due."""
        return sum(one.due for one in self.campaigns)

    @property
    def due_bytes(self) -> int:
        """Of those that are due."""
        return sum(one.due_bytes for one in self.campaigns)

    @property
    def newest(self) -> datetime | None:
        """When a file was compared last."""
        return max((one.newest for one in self.campaigns if one.newest is not None), default=None)
