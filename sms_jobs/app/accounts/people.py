"""People: who they are, how they come in, and what lets programs in for them.

Passwords are hashed by argon2 here and nowhere else. A session ends 12 h after the log-in, or once an hour
has passed without a request.
"""

from __future__ import annotations

import hashlib
import secrets
import threading
import unicodedata
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import TYPE_CHECKING

from pydantic import SecretStr
from sqlalchemy.orm import Session

from sms_jobs.app.rules import Rule, require, use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import access, audit
from sms_jobs.catalogue import people as known
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.deeds import Deed
from sms_jobs.catalogue.tables.access import AccessRow
from sms_jobs.catalogue.tables.people import PersonRow
from sms_jobs.errors import Conflict, InvalidInput, NotAllowed, NotFound
from sms_jobs.records.people import NOT_FOR_PEOPLE, SECRET_PREFIX, Actor, Right, Role, without_secrets
from sms_jobs.records.shown.people import AccessView, PersonView
from sms_jobs.records.subject import checked_name
from sms_jobs.records.texts import checked_text

if TYPE_CHECKING:
    from argon2 import PasswordHasher

SHORTEST_PASSWORD, LONGEST_PASSWORD = 12, 1024
"""In letters."""
SESSION_ENDS = timedelta(hours=12)
SESSION_IDLE = timedelta(hours=1)
LONGEST_TOKEN_DAYS = 366

_TRIES = 5
_LOCK, _LONGEST_LOCK = timedelta(minutes=1), timedelta(hours=1)
_USE_NOTED_EVERY = timedelta(minutes=1)
_LABEL_LETTERS = 200
_HASHING = threading.BoundedSemaphore(2)
"""Each takes 64 MiB: a crowd of log-ins must not take the memory of the jobs."""
_REFUSED = (
    "the name or the password is not right, or there were too many wrong ones lately; try again in some "
    "minutes, or ask an administrator for a new password"
)
_ENDED = "this token or session is unknown, has ended or was revoked; log in again, or make another token"


@dataclass(frozen=True)
class LoggedIn:
    """A session that was started; `secret` is shown this once, and lets its holder in as the person."""

    secret: str
    name: str
    role: Role
    expires_at: datetime


@dataclass(frozen=True)
class NewToken:
    """A token that was made; `secret` is shown this once, and `id` is what it is revoked by."""

    id: str
    secret: str
    label: str
    expires_at: datetime


@use_case(None)
def has_people(services: Services) -> bool:
    """Return whether has_people has a name here; before that, everybody at the desk may do everything."""
    with services.catalogue.reading() as session:
        return known.has_people(session)


@use_case(None)
def log_in(services: Services, name: str, password: SecretStr) -> LoggedIn:
    """Begin a session, as a browser has it.

    Raises `NotAllowed`, in the same words and after the same time, for a name that is not known, a wrong
    password, a person who may not come in, and an account that is locked: for a minute after 5 wrong
    passwords, twice as long after each further one, an hour at most.
    """
    _prove(services, name, password, "people.log_in")
    return begin_session(services.catalogue, services.actor, name, "people.log_in")


def begin_session(catalogue: Catalogue, asking: Actor, name: str, action: str) -> LoggedIn:
    """Begin a session of somebody who has proved to be that person, however that was done.

    Raises `NotAllowed` where the person may not come in.
    """
    with catalogue.reading() as session:
        person = known.find(session, name)
    if person is None:
        raise NotAllowed(_REFUSED)
    secret, now, role = _new_secret(), datetime.now(UTC), Role(person.role)
    with catalogue.for_deed(Deed(replace(asking, name=name, role=role), action, {})).writing() as session:
        row = access.add(session, person, access.SESSION, "", _hash_of(secret), now, now + SESSION_ENDS)
    return LoggedIn(secret, name, role, row.expires_at)


@use_case(None)
def actor_of(services: Services, secret: str, origin: str) -> Actor:
    """Return whose token or session has a secret, and note that it was used.

    Parameters
    ----------
    origin
        Where the request came from.

    Raises `NotAllowed` for one that is unknown, has ended or was revoked, or whose person may not come in.
    """
    now = datetime.now(UTC)
    with services.catalogue.reading() as session:
        found = access.of_secret(session, _hash_of(secret))
    if found is None or not _lets_in(*found, now):
        raise NotAllowed(_ENDED)
    row, person = found
    if row.used_at is None or now - row.used_at >= _USE_NOTED_EVERY:
        with services.catalogue.writing() as session:
            access.note_use(session, row.id, now)
    via = "token" if row.sort == access.TOKEN else "web"
    return Actor(person.name, Role(person.role), via, origin[:128])


@use_case(None)
def log_out(services: Services, secret: str) -> None:
    """End a session; one that has ended, or is none, is no error."""
    now = datetime.now(UTC)
    with services.catalogue.reading() as session:
        found = access.of_secret(session, _hash_of(secret))
    if found is None or found[0].sort != access.SESSION or not _lets_in(*found, now):
        return
    row, person = found
    actor = replace(services.actor, name=person.name, role=Role(person.role))
    with services.catalogue.for_deed(Deed(actor, "people.log_out", {})).writing() as session:
        access.revoke(session, row.id, now)


@use_case(None)
def confirmed(services: Services, password: SecretStr) -> Services:
    """Return the same services for an actor who has given the password again; raises as `log_in` does."""
    _prove(services, services.actor.name, password, "people.confirmed")
    return services.acting(replace(services.actor, confirmed=True))


@use_case(Right.ADMINISTER)
def list_people(services: Services) -> list[PersonView]:
    """Return everybody who has a name here, in order of name."""
    with services.catalogue.reading() as session:
        return known.listed(session)


@use_case(Right.ADMINISTER)
def add(services: Services, name: str, role: Role, password: SecretStr | None = None) -> PersonView:
    """Give somebody a name; the first has to be an administrator.

    Parameters
    ----------
    password
        None for somebody who comes in by the account of that name alone.

    Raises
    ------
    InvalidInput
        The name or the password cannot be used.
    Conflict
        The name is taken, or nobody would be an administrator.
    """
    checked_name(name, "person")
    if name in NOT_FOR_PEOPLE:
        raise InvalidInput(f"'{name}' stands for others in the audit; choose another name")
    hashed = None if password is None else _hashed(_checked(password))
    with services.catalogue.writing() as session:
        if role is not Role.ADMINISTRATOR and not known.has_people(session):
            raise Conflict(
                f"the first person has to be an administrator, not {role.value}: from then on everybody is "
                "asked who they are; add that one first"
            )
        return known.person_view(known.add(session, name, role, hashed, datetime.now(UTC)))


@use_case(Right.ADMINISTER)
def set_role(services: Services, name: str, role: Role) -> PersonView:
    """Let somebody do more or less from now on.

    Raises
    ------
    NotFound
        There is nobody of that name.
    Conflict
        Nobody would be left who is an administrator.
    """
    with services.catalogue.writing() as session:
        row = known.named(session, name)
        if role is not Role.ADMINISTRATOR:
            known.require_another_administrator(session, row)
        row.role = role.value
        return known.person_view(row)


@use_case(Right.ADMINISTER)
def set_active(services: Services, name: str, active: bool) -> PersonView:
    """Let somebody come in no more, or again; tokens and sessions end at once and stay ended.

    Raises as `set_role` does.
    """
    now = datetime.now(UTC)
    with services.catalogue.writing() as session:
        row = known.named(session, name)
        if not active:
            known.require_another_administrator(session, row)
            access.revoke_of(session, row, now, access.SESSION, access.TOKEN)
        row.active, row.failures, row.locked_until = active, 0, None
        return known.person_view(row)


@use_case(None)
def set_password(services: Services, name: str, password: SecretStr, old: SecretStr | None = None) -> None:
    """Give a person a password, one's own or, as an administrator, somebody else's; sessions end with it.

    Parameters
    ----------
    old
        That the person has now; needed for one's own.

    Raises
    ------
    NotAllowed
        It is somebody else's, the old one is wrong, or there is none and the actor came over the network.
    InvalidInput
        The new one is too short or too long.
    NotFound
        There is nobody of that name.
    """
    own = name == services.actor.name
    rule = Rule("people.set_password", Right.OWN if own else Right.ADMINISTER)
    require(services, rule)
    new = _checked(password)
    with services.catalogue.reading() as session:
        has_one = known.named(session, name).password is not None
    if own and (has_one or services.actor.via in ("web", "token")):
        _prove(services, name, old or SecretStr(""), rule.name)
    hashed, now = _hashed(new), datetime.now(UTC)
    with services.catalogue.for_deed(Deed(services.actor, rule.name, {"name": name})).writing() as session:
        row = known.named(session, name)
        row.password, row.failures, row.locked_until = hashed, 0, None
        access.revoke_of(session, row, now, access.SESSION)


@use_case(Right.OWN)
def create_token(services: Services, label: str, days: int = 90) -> NewToken:
    """Make a token with which a program comes in as the actor.

    Parameters
    ----------
    label
        What it is for.
    days
        Until it ends, 366 at most.

    Raises
    ------
    InvalidInput
        The label is empty or too long, or the days are none or too many.
    NotFound
        The actor has no name here.
    NotAllowed
        The actor came in by a token, which makes no others.
    """
    label = checked_text(without_secrets(label.strip()), "a label", _LABEL_LETTERS)
    if not label:
        raise InvalidInput("a token needs a label that says what it is for; give one")
    if not 1 <= days <= LONGEST_TOKEN_DAYS:
        raise InvalidInput(f"a token cannot end after {days} days; give 1 to {LONGEST_TOKEN_DAYS}")
    if services.actor.via == "token":
        raise NotAllowed("a token makes no other tokens; log in with the password to make one")
    secret, now = _new_secret(), datetime.now(UTC)
    with services.catalogue.writing() as session:
        person = _own(session, services)
        ends = now + timedelta(days=days)
        row = access.add(session, person, access.TOKEN, label, _hash_of(secret), now, ends)
    return NewToken(row.id, secret, label, ends)


@use_case(Right.OWN)
def list_access(services: Services, name: str | None = None) -> list[AccessView]:
    """Return the tokens and sessions that still let a person in, the newest first.

    Parameters
    ----------
    name
        Of somebody else, for administrators; the actor if it is None.

    Raises
    ------
    NotAllowed
        It is somebody else and the actor no administrator.
    NotFound
        There is nobody of that name.
    """
    if name is not None and name != services.actor.name:
        require(services, Rule("people.list_access", Right.ADMINISTER))
    with services.catalogue.reading() as session:
        person = _own(session, services) if name is None else known.named(session, name)
        return access.listed(session, person.name, datetime.now(UTC))


@use_case(Right.OWN)
def revoke(services: Services, access_id: str) -> AccessView:
    """Let a token or session let nobody in any more: one's own or, as an administrator, has_people's.

    Raises
    ------
    NotFound
        There is none of that id, or it is somebody else's and the actor no administrator.
    """
    with services.catalogue.writing() as session:
        found = access.numbered(session, access_id)
        if found.person != services.actor.name and not services.actor.may(Right.ADMINISTER):
            raise NotFound(f"you have no token or session '{access_id}'; 'sms token list' shows yours")
        access.revoke(session, access_id, datetime.now(UTC))
        return found


def _own(session: Session, services: Services) -> PersonRow:
    row = known.find(session, services.actor.name)
    if row is None:
        raise NotFound(
            f"{services.actor.name} has no name here, and so no tokens; 'sms person add' gives one"
        )
    return row


def _prove(services: Services, name: str, password: SecretStr, action: str) -> Role:
    """Return the role of the person whose password it is; count it, and raise `NotAllowed`, if it is not.

    Nothing is decided before the password has been hashed, and whether the account is locked only while it is
    counted: of many tries at once five are answered.
    """
    with services.catalogue.reading() as session:
        before = known.find(session, name)
        stored = None if before is None else before.password
    right = _is_right(stored, password)
    fresh = _hashed(password) if right and stored and _hasher().check_needs_rehash(stored) else None
    now = datetime.now(UTC)
    with services.catalogue.writing() as session:
        row = known.find(session, name, to_change=True)
        is_open = row is not None and (row.locked_until is None or row.locked_until <= now)
        if row is not None and is_open and right and row.password == stored:
            row.failures, row.locked_until, row.password = 0, None, fresh or stored
            return Role(row.role)
        if row is not None and is_open:
            row.failures += 1
            row.locked_until = _locked_until(row.failures, now)
        # A name that nobody has may be a password that was typed in the wrong place: it is not kept.
        refused: dict[str, object] = {"refused": "an unknown name" if row is None else row.name}
        audit.append(session, Deed(services.actor, action, refused), now)
    raise NotAllowed(_REFUSED)


def _locked_until(failures: int, now: datetime) -> datetime | None:
    """Return until when no password is taken after so many wrong ones in a row."""
    if failures < _TRIES:
        return None
    return now + min(_LOCK * (1 << min(failures - _TRIES, 10)), _LONGEST_LOCK)


def _lets_in(row: AccessRow, person: PersonRow, now: datetime) -> bool:
    if row.revoked_at is not None or row.expires_at <= now or not person.active:
        return False
    return row.sort == access.TOKEN or now - (row.used_at or row.created_at) < SESSION_IDLE


def _new_secret() -> str:
    return SECRET_PREFIX + secrets.token_urlsafe(32)


def _hash_of(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def _checked(password: SecretStr) -> SecretStr:
    """Return a password that may be set; raise `InvalidInput`, without repeating it, if it may not."""
    if not SHORTEST_PASSWORD <= len(password.get_secret_value()) <= LONGEST_PASSWORD:
        raise InvalidInput(
            f"a password has {SHORTEST_PASSWORD} letters at least and {LONGEST_PASSWORD} at most, any "
            "letters; choose another"
        )
    return password


@cache
def _hasher() -> PasswordHasher:
    from argon2 import PasswordHasher  # nobody waits for it who gives no password

    return PasswordHasher()


def _hashed(password: SecretStr) -> str:
    with _HASHING:
        return _hasher().hash(_as_bytes(password))


def _is_right(stored: str | None, password: SecretStr) -> bool:
    """Say whether it is the password that was stored; without one it takes as long to say no."""
    from argon2.exceptions import InvalidHashError, VerificationError

    if stored is None:
        _hashed(password)
        return False
    with _HASHING:
        try:
            return _hasher().verify(stored, _as_bytes(password))
        except (VerificationError, InvalidHashError):
            return False


def _as_bytes(password: SecretStr) -> bytes:
    """Return what is hashed: the same whichever way a keyboard composes a letter, and never endless."""
    text = password.get_secret_value()[: LONGEST_PASSWORD + 1]
    return unicodedata.normalize("NFKC", text).encode("utf-8", "surrogatepass")
