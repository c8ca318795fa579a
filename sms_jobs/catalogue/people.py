"""People who have a name here."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.people_tables import PersonRow
from sms_jobs.errors import NotFound


def anybody(session: Session) -> bool:
    """Return whether anybody has a name here; before that, everybody at the desk may do everything."""
    return session.scalar(select(PersonRow.id).limit(1)) is not None


def find(session: Session, name: str) -> PersonRow | None:
    """Return the person of that name who may come in; None where there is none."""
    return session.scalars(
        select(PersonRow).where(PersonRow.name == name, PersonRow.active.is_(True))
    ).one_or_none()


def named(session: Session, name: str) -> PersonRow:
    """Return the person of that name, active or not; raise `NotFound` where there is none."""
    row = session.scalars(select(PersonRow).where(PersonRow.name == name)).one_or_none()
    if row is None:
        raise NotFound(f"there is nobody called '{name}'; 'sms person list' shows who is there")
    return row
