"""People, their tokens and sessions, and what was done, as they are shown."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sms_jobs.records.people import Role


@dataclass(frozen=True)
class PersonView:
    """Somebody who has a name here.

    Attributes
    ----------
    active
        Whether the person may come in.
    has_password
        Without one, only an account of that name, or a token, lets the person in.
    locked_until
        Until when no password is taken, after too many wrong ones; None if one is.
    """

    name: str
    role: Role
    active: bool
    has_password: bool
    created_at: datetime
    locked_until: datetime | None


@dataclass(frozen=True)
class AccessView:
    """A token or a session that still lets a person in.

    Attributes
    ----------
    id
        By which it is revoked; it opens nothing.
    sort
        `token` or `session`.
    used_at
        When it was last used, to a minute.
    """

    id: str
    person: str
    sort: str
    label: str
    created_at: datetime
    expires_at: datetime
    used_at: datetime | None


@dataclass(frozen=True)
class Link:
    """Something that was done, as the audit holds it.

    Attributes
    ----------
    number
        Its place in the chain, from 1.
    role
        That the person had then; empty for somebody who had not logged in.
    digest
        SHA-256 of it and of the digest of the link before it, in hexadecimal.
    """

    number: int
    at: datetime
    who: str
    role: str
    via: str
    origin: str
    action: str
    arguments: dict[str, Any]
    reason: str
    digest: str
