"""Who does something, and what people may do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Right(Enum):
    """What a use case asks of whoever calls it."""

    READ = "read"
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
    Role.VIEWER: frozenset({Right.READ}),
    Role.ANALYST: frozenset({Right.READ, Right.COMPUTE}),
    Role.OPERATOR: frozenset({Right.READ, Right.COMPUTE, Right.RECORD}),
    Role.METROLOGIST: frozenset({Right.READ, Right.COMPUTE, Right.CERTIFY}),
    Role.ADMINISTRATOR: frozenset(Right),
}


@dataclass(frozen=True)
class Actor:
    """Whoever does something: a person, or the service by itself.

    Attributes
    ----------
    name
        Of the person, or of the account on the host where nobody has a name.
    role
        Which decides what the actor may do.
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
    role: Role
    via: str
    origin: str
    confirmed: bool = False
    reason: str = ""

    def may(self, right: Right) -> bool:
        """Return whether the role has the right."""
        return right in RIGHTS[self.role]


@dataclass(frozen=True)
class Deed:
    """Something that an actor does and that is kept.

    Attributes
    ----------
    actor
        Who does it.
    action
        Name of the use case, as `jobs.cancel`.
    arguments
        That were given to it, as JSON.
    """

    actor: Actor
    action: str
    arguments: dict[str, object]
