"""Tokens and sessions: found by the hash of their secret, and revoked."""

from __future__ import annotations

import secrets
from datetime import datetime

from sqlalchemy import ColumnElement, select, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.access import AccessRow
from sms_jobs.catalogue.tables.people import PersonRow
from sms_jobs.errors import NotFound
from sms_jobs.records.shown.people import AccessView

SESSION = "session"
TOKEN = "token"  # noqa: S105 - a sort of access


def add(
    session: Session,
    person: PersonRow,
    sort: str,
    label: str,
    secret_hash: str,
    now: datetime,
    expires_at: datetime,
) -> AccessRow:
    """Enter a token or a session."""
    row = AccessRow(
        id=secrets.token_hex(8),
        person_id=person.id,
        sort=sort,
        label=label,
        secret_hash=secret_hash,
        created_at=now,
        expires_at=expires_at,
    )
    session.add(row)
    session.flush()
    return row


def of_secret(session: Session, secret_hash: str) -> tuple[AccessRow, PersonRow] | None:
    """Return what has that secret and whose it is, whether it still lets in or not."""
    found = session.execute(
        select(AccessRow, PersonRow)
        .join(PersonRow, PersonRow.id == AccessRow.person_id)
        .where(AccessRow.secret_hash == secret_hash)
    ).one_or_none()
    return None if found is None else (found[0], found[1])


def note_use(session: Session, access_id: str, now: datetime) -> None:
    """Enter when it was used last."""
    session.execute(update(AccessRow).where(AccessRow.id == access_id).values(used_at=now))


def listed(session: Session, name: str, now: datetime) -> list[AccessView]:
    """Return what still lets a person in, the newest first."""
    found = session.execute(
        select(AccessRow, PersonRow.name)
        .join(PersonRow, PersonRow.id == AccessRow.person_id)
        .where(PersonRow.name == name, AccessRow.revoked_at.is_(None), AccessRow.expires_at > now)
        .order_by(AccessRow.created_at.desc(), AccessRow.id)
    )
    return [access_view(row, person) for row, person in found]


def access_view(row: AccessRow, person: str) -> AccessView:
    """Return a token or session as shown."""
    return AccessView(row.id, person, row.sort, row.label, row.created_at, row.expires_at, row.used_at)


def numbered(session: Session, access_id: str) -> AccessView:
    """Return the token or session of that id; raise `NotFound` where there is none that is not revoked."""
    found = session.execute(
        select(AccessRow, PersonRow.name)
        .join(PersonRow, PersonRow.id == AccessRow.person_id)
        .where(AccessRow.id == access_id, AccessRow.revoked_at.is_(None))
    ).one_or_none()
    if found is None:
        raise NotFound(f"there is no token or session '{access_id}'; 'sms token list' shows them")
    return access_view(found[0], found[1])


def revoke(session: Session, access_id: str, now: datetime) -> None:
    """Let a token or session let nobody in any more."""
    _revoke(session, AccessRow.id == access_id, now)


def revoke_of(session: Session, person: PersonRow, now: datetime, *sorts: str) -> None:
    """Revoke a person's tokens, sessions, or both."""
    _revoke(session, (AccessRow.person_id == person.id) & AccessRow.sort.in_(sorts), now)


def _revoke(session: Session, which: ColumnElement[bool], now: datetime) -> None:
    session.execute(
        update(AccessRow)
        .where(which, AccessRow.revoked_at.is_(None))
        .values(revoked_at=now)
        .execution_options(synchronize_session=False)
    )
