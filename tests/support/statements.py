"""What a test hears of the database: the statements that are run, and how many values each is given."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import event

from sms_jobs.catalogue.database import Catalogue


@dataclass
class Heard:
    """Statements, and the values of each; one for many rows counts with those of a row."""

    statements: list[str] = field(default_factory=list)
    values: list[int] = field(default_factory=list)

    @property
    def most_values(self) -> int:
        """Of one statement."""
        return max(self.values, default=0)


@contextmanager
def heard(catalogue: Catalogue) -> Iterator[Heard]:
    """Listen to a catalogue for a while."""
    found = Heard()

    def listen(_c: Any, _cursor: Any, statement: str, given: Any, _context: Any, many: bool) -> None:
        found.statements.append(statement)
        found.values.append(max(map(len, given), default=0) if many else len(given or ()))

    event.listen(catalogue.engine, "before_cursor_execute", listen)
    try:
        yield found
    finally:
        event.remove(catalogue.engine, "before_cursor_execute", listen)
