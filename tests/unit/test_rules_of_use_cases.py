"""No use case hands a password or a secret to the audit."""

from __future__ import annotations

import inspect
import pkgutil
import typing
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

import sms_jobs.app
from sms_jobs.app import rules
from sms_jobs.app.accounts import people
from sms_jobs.records.people import RIGHTS, Actor, Right, Role

SECRET = "sms_" + "aB3-_" * 8 + "xyz"


def use_cases() -> Iterator[Callable[..., Any]]:
    for found in pkgutil.walk_packages(sms_jobs.app.__path__, "sms_jobs.app."):
        module = import_module(found.name)
        for one in vars(module).values():
            if rules.rule_of(one) is not None and one.__module__ == module.__name__:
                yield one


def test_whatever_is_secret_has_a_type_that_says_so() -> None:
    # Secrets of tokens and sessions are known by their form as well.
    by_form = {(people.actor_of.__name__, "secret"), (people.log_out.__name__, "secret")}
    names = {"password", "old", "new", "secret", "token", "passphrase"}
    seen = set()
    for function in use_cases():
        for name in inspect.signature(function).parameters:
            if name in names and (function.__name__, name) not in by_form:
                assert SecretStr in (hint := typing.get_type_hints(function)[name], *typing.get_args(hint))
                seen.add(function.__name__)
    assert seen == {"add", "confirmed", "log_in", "set_password"}


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (SecretStr("hush"), None),
        (f"of {SECRET}!", "of sms_...!"),
        (Path("/x") / SECRET, "sms_..."),
        ({SECRET: [SECRET, SecretStr("hush")]}, {"sms_...": ["sms_...", None]}),
        (Actor(SECRET, Role.VIEWER, "web", ""), "sms_..."),
    ],
)
def test_what_is_secret_is_not_told(given: Any, told: Any) -> None:
    found = rules._told(given)
    assert (found["name"] if isinstance(given, Actor) else found) == told


def test_everybody_who_is_known_may_read_and_look_after_their_own() -> None:
    assert all({Right.READ, Right.OWN} <= rights for rights in RIGHTS.values())
    assert not any(Actor("x", None, "web", "").may(right) for right in Right)
