"""Whether there is any plan of recordings, told without loading what plans consist of."""

from __future__ import annotations

from sqlalchemy import text
from sqlalchemy.orm import Session

_ANY = text(
    "SELECT EXISTS (SELECT 1 FROM planned_recording) OR EXISTS (SELECT 1 FROM planned_levels) AS there"
)


def any_plans(session: Session) -> bool:
    """Return whether a recording was ever planned, whatever became of it, or levels are."""
    return bool(session.scalar(_ANY))
