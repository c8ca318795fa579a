"""Queries that are kept under a name, to be asked again."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.queries import files
from sms_jobs.catalogue.queries.fields import Vocabulary
from sms_jobs.catalogue.queries.language import parse
from sms_jobs.catalogue.tables.saved_queries import SavedQueryRow
from sms_jobs.errors import Conflict, InvalidInput, NotFound

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True)
class SavedQuery:
    """A query and its name."""

    name: str
    text: str
    saved_at: datetime


def save(
    session: Session, name: str, text: str, now: datetime, vocabulary: Vocabulary, *, replace: bool = False
) -> SavedQuery:
    """Keep a query that can be asked.

    Raises
    ------
    InvalidInput, NotFound
        The name has other characters than letters, digits, - and _, or the query cannot be asked.
    Conflict
        There is one of that name, and it is not to be replaced.
    """
    if not _NAME.fullmatch(name):
        raise InvalidInput(
            f"a query cannot be called '{name}': use up to 64 letters, digits, - and _, like high-strain"
        )
    files.check(session, parse(text), vocabulary)
    row = session.scalar(select(SavedQueryRow).where(SavedQueryRow.name == name))
    if row is not None and not replace:
        raise Conflict(f"there is already a query '{name}'; choose another name, or set `force`")
    if row is None:
        row = SavedQueryRow(name=name)
        session.add(row)
    row.text, row.saved_at = text, now
    session.flush()
    return SavedQuery(row.name, row.text, row.saved_at)


def saved(session: Session) -> list[SavedQuery]:
    """Return all saved queries by name."""
    rows = session.scalars(select(SavedQueryRow).order_by(SavedQueryRow.name))
    return [SavedQuery(row.name, row.text, row.saved_at) for row in rows]


def text_of(session: Session, name: str) -> str:
    """Return the query of that name; raise `NotFound`, naming those that there are."""
    found = session.scalar(select(SavedQueryRow.text).where(SavedQueryRow.name == name))
    if found is None:
        names = [query.name for query in saved(session)]
        hint = (
            f"there are {', '.join(names)}"
            if names
            else "none is saved yet; see 'sms data query save --help'"
        )
        raise NotFound(f"there is no saved query '{name}'; {hint}")
    return found


def remove(session: Session, name: str) -> None:
    """Forget a query; raise `NotFound` where there is none of that name."""
    text_of(session, name)
    session.execute(delete(SavedQueryRow).where(SavedQueryRow.name == name))
