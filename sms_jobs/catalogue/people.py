"""People who have a name here."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.people import PersonRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.records.people import Role

if TYPE_CHECKING:
    from sms_jobs.records.shown.people import PersonView


def has_people(session: Session) -> bool:
    """Return whether anybody has a name here; before that, everybody at the desk may do everything."""
    return session.scalar(select(PersonRow.id).limit(1)) is not None


def find(session: Session, name: str, *, to_change: bool = False) -> PersonRow | None:
    """Return the person of that name who may come in; None where there is none.

    With `to_change`, others who would change the person wait.
    """
    query = select(PersonRow).where(PersonRow.name == name, PersonRow.active.is_(True))
    return session.scalars(query.with_for_update() if to_change else query).one_or_none()


def named(session: Session, name: str) -> PersonRow:
    """Return the person of that name, active or not; raise `NotFound` where there is none."""
    row = session.scalars(select(PersonRow).where(PersonRow.name == name)).one_or_none()
    if row is None:
        raise NotFound(f"there is no person '{name}'; 'sms person list' shows all")
    return row


def listed(session: Session) -> list[PersonView]:
    """Return everybody, in order of name."""
    return [person_view(row) for row in session.scalars(select(PersonRow).order_by(PersonRow.name))]


def person_view(row: PersonRow) -> PersonView:
    """Return a person as shown."""
    from sms_jobs.records.shown.people import PersonView

    return PersonView(
        row.name, Role(row.role), row.active, row.password is not None, row.created_at, row.locked_until
    )


def add(session: Session, name: str, role: Role, password: str | None, now: datetime) -> PersonRow:
    """Give somebody a name; raise `Conflict` where it is taken, or differs from one in case alone.

    `password` is hashed already.
    """
    alike = session.scalar(select(PersonRow.name).where(func.lower(PersonRow.name) == name.lower()))
    if alike not in (None, name):
        raise Conflict(
            f"there is already a person '{alike}', and '{name}' differs in case alone; choose another name"
        )
    row = PersonRow(name=name, role=role.value, password=password, active=True, created_at=now)
    session.add(row)
    try:
        session.flush()
    except IntegrityError as error:
        raise Conflict(f"there is already a person '{name}'; choose another name") from error
    return row


def require_another_administrator(session: Session, row: PersonRow) -> None:
    """Raise `Conflict` where a person is the only administrator who may come in.

    Nobody else becomes the last one meanwhile: whoever would change one waits.
    """
    active = (
        select(PersonRow.name)
        .where(PersonRow.role == Role.ADMINISTRATOR.value, PersonRow.active.is_(True))
        .order_by(PersonRow.id)
        .with_for_update()
    )
    if list(session.scalars(active)) == [row.name]:
        raise Conflict(
            f"{row.name} is the last active administrator; make someone else one with 'sms person role' first"
        )


def of_identity(session: Session, identity: str, *, active: bool = True) -> PersonRow | None:
    """Return whom an identity provider knows by its issuer and subject; None where that is nobody.

    Without `active` also somebody who may not come in.
    """
    row = session.scalars(select(PersonRow).where(PersonRow.identity == identity)).one_or_none()
    return None if row is None or (active and not row.active) else row
