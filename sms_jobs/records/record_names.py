"""How a record is called in its file; no other module knows how that is written.

It is a name and, where a file has several records of that name, a key behind it, such as a camera's name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

PICTURED: Final = frozenset(
    {"measurement", "surface", "displacement", "strain", "assessment", "merged", "deviation"}
)
"""Names of the records that are images."""


@dataclass(frozen=True)
class RecordName:
    """A record's name, and its key; empty where a file has one alone."""

    name: str
    key: str = ""

    def __str__(self) -> str:
        return f"{self.name}_{self.key}" if self.key else self.name

    @classmethod
    def parse(cls, text: str) -> RecordName:
        """Read what a record is called in its file; the key goes on from the first underscore."""
        name, _, key = text.partition("_")
        return cls(name, key)
