"""Who may call which use case, and that what is changed is told with who changed it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import datetime
from enum import Enum
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from pydantic import SecretStr

from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.deeds import Deed
from sms_jobs.errors import NotAllowed, PasswordNeeded
from sms_jobs.records.people import RIGHTS, Right, without_secrets
from sms_jobs.records.texts import harmless

P = ParamSpec("P")
R = TypeVar("R")

_LONGEST = 500
_MOST = 20


@dataclass(frozen=True)
class Rule:
    """What a use case asks of whoever calls it.

    Attributes
    ----------
    name
        Of the use case, as `jobs.cancel`.
    right
        That the actor must have; None where anybody may call it, logged in or not.
    confirm
        Whether the actor must just have given the password again.
    """

    name: str
    right: Right | None
    confirm: bool = False


def use_case(
    right: Right | None, *, confirm: bool = False
) -> Callable[[Callable[Concatenate[Services, P], R]], Callable[Concatenate[Services, P], R]]:
    """Declare a function of services as a use case: refused without the right, and told where it changes.

    Any right but that to read makes a deed of a call: the first change of the catalogue that it commits
    enters it into the audit, in the same transaction. What anybody may call enters by itself what is to be
    kept, once it knows whose deed it is.

    The function then raises
    ------------------------
    NotAllowed
        The actor has not the right.
    PasswordNeeded
        The password has to be given again first.
    """

    def declare(function: Callable[Concatenate[Services, P], R]) -> Callable[Concatenate[Services, P], R]:
        rule = Rule(f"{function.__module__.rpartition('.')[2]}.{function.__name__}", right, confirm)
        signature = inspect.signature(function)

        @wraps(function)
        def ruled(services: Services, /, *args: P.args, **kwargs: P.kwargs) -> R:
            require(services, rule)
            catalogue = services.catalogue
            if right is Right.READ:
                catalogue = catalogue.for_reading()
            elif right is not None:
                given = signature.bind(services, *args, **kwargs).arguments
                catalogue = catalogue.for_deed(Deed(services.actor, rule.name, _arguments(given)))
            services = replace(services, catalogue=catalogue)
            return function(services, *args, **kwargs)

        ruled.rule = rule  # type: ignore[attr-defined]
        return ruled

    return declare


def rule_of(function: Callable[..., Any]) -> Rule | None:
    """Return the rule of a use case; None for a function that is none."""
    return getattr(function, "rule", None)


def require(services: Services, rule: Rule) -> None:
    """Raise unless the actor may do what the rule is about.

    Raises
    ------
    NotAllowed
        The actor has not the right.
    PasswordNeeded
        The password has to be given again first.
    """
    actor = services.actor
    if rule.right is not None and not actor.may(rule.right):
        if actor.role is None:
            raise NotAllowed(f"{rule.name} is for people who are known here; log in, or give a token")
        able = ", ".join(role.value for role, rights in RIGHTS.items() if rule.right in rights)
        raise NotAllowed(
            f"{actor.name} is {actor.role.value} and may not {rule.right.value} ({rule.name}): that is for "
            f"{able}; an administrator can change roles with 'sms person role'"
        )
    if rule.confirm and not actor.confirmed:
        raise PasswordNeeded(f"{rule.name} asks for the password of {actor.name} again")


def _arguments(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return what was given besides services, without what says nothing."""
    told = {name: _told(value) for name, value in list(given.items())[1:]}
    return {name: value for name, value in told.items() if value not in (None, [], {}, False)}


def _told(value: Any) -> Any:
    """Return an argument as the audit keeps it: as JSON, and never endless."""
    if isinstance(value, Enum):
        return value.value
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        return value if abs(value) < float("inf") else str(value)
    if isinstance(value, SecretStr | bytes | memoryview):
        return None
    if isinstance(value, Path):
        return _text(value.name)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, datetime):
        return value.isoformat()
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _told(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {_text(str(k)): _told(v) for k, v in list(value.items())[:_MOST]}
    if isinstance(value, list | tuple | set | frozenset):
        return _few(value)
    return None if callable(value) else _text(str(value))


def _text(text: str) -> str:
    return harmless(without_secrets(text))[:_LONGEST]


def _few(values: Iterable[Any]) -> list[Any]:
    told = [_told(value) for value in values]
    more = len(told) - _MOST
    return told if more <= 0 else [*told[:_MOST], f"and {more} more"]
