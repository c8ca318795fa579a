"""Who does something, and what people may do."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from typing import Final


class Right(Enum):
    """What a use case asks of whoever calls it."""

    READ = "read"
    OWN = "own"
    """To look after what is their own: password, tokens and sessions."""
    COMPUTE = "compute"
    RECORD = "record"
    CERTIFY = "certify"
    ADMINISTER = "administer"


class Role(Enum):
    """What a person is to the laboratory; `RIGHTS` says what each may do."""

    VIEWER = "viewer"
    ANALYST = "analyst"
    OPERATOR = "operator"
    METROLOGIST = "metrologist"
    ADMINISTRATOR = "administrator"


RIGHTS = {
    Role.VIEWER: frozenset({Right.READ, Right.OWN}),
    Role.ANALYST: frozenset({Right.READ, Right.OWN, Right.COMPUTE}),
    Role.OPERATOR: frozenset({Right.READ, Right.OWN, Right.COMPUTE, Right.RECORD}),
    Role.METROLOGIST: frozenset({Right.READ, Right.OWN, Right.COMPUTE, Right.CERTIFY}),
    Role.ADMINISTRATOR: frozenset(Right),
}

NOT_FOR_PEOPLE: Final = frozenset({"nobody", "service"})
"""Names that the audit uses for others."""

SECRET_PREFIX: Final = "sms_"  # noqa: S105 - of secrets, and none itself
"""Of every token and session secret, so that one that leaked is recognised."""
_SECRET = re.compile(rf"{SECRET_PREFIX}[A-Za-z0-9_-]{{43}}")


def without_secrets(text: str) -> str:
    """Return a text in which no token or session secret stands any more."""
    return _SECRET.sub(f"{SECRET_PREFIX}...", text)


@dataclass(frozen=True)
class Actor:
    """Whoever does something: a person, or the service by itself.

    Attributes
    ----------
    name
        Of the person, or of the account on the host where nobody has a name.
    role
        Which decides what the actor may do; None for somebody who has not said who it is, and may do nothing.
    via
        How: `command`, `python`, `web`, `token` or `service`.
    origin
        From where: a host, or a network address.
    confirmed
        Whether the actor has just given the password again, or has none.
    reason
        Why, where one was asked for.
    """

    name: str
    role: Role | None
    via: str
    origin: str
    confirmed: bool = False
    reason: str = ""

    def may(self, right: Right) -> bool:
        """Return whether the role has the right."""
        return self.role is not None and right in RIGHTS[self.role]


ANONYMOUS: Final = Actor("nobody", None, "web", "")
"""Whoever has not logged in."""
