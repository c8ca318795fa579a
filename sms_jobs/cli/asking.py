"""What a command asks back: passwords, which are not shown, and reasons."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, TypeVar

import typer
from pydantic import SecretStr

from sms_jobs.app.accounts import people
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput, PasswordNeeded

T = TypeVar("T")

PasswordStdin = Annotated[
    bool, typer.Option("--password-stdin", help="Read the password from standard input, for scripts.")
]
Reason = Annotated[
    str | None, typer.Option(help="Why; kept in the audit. Asked for on a terminal.", show_default=False)
]


def password(question: str, from_stdin: bool, *, new: bool = False, empty: bool = False) -> SecretStr:
    """Return a password, asked for on the terminal, twice where it is new, or the next line of stdin.

    Raises `InvalidInput` where there is neither.
    """
    if from_stdin:
        line = sys.stdin.readline()
        if not line:
            raise InvalidInput(
                f"standard input ends before the password ({question}); write one a line to it"
            )
        return SecretStr(line.rstrip("\r\n"))
    if not _is_watched():
        raise InvalidInput(
            f"there is no terminal to ask for the password ({question}); give --password-stdin"
        )
    again = f"{question}, again" if new else False
    default = "" if empty else None
    return SecretStr(
        typer.prompt(
            question, default, hide_input=True, confirmation_prompt=again, show_default=False, err=True
        )
    )


def because(services: Services, reason: str | None) -> Services:
    """Return services of an actor who says why; asked for on a terminal where it was not given."""
    if reason is None and _is_watched():
        reason = typer.prompt("Reason, for the audit (Enter for none)", "", show_default=False, err=True)
    return services.because(reason or "")


def confirming(services: Services, from_stdin: bool, do: Callable[[Services], T]) -> T:
    """Do something and return what it gives; ask for the password where it has to be given again first."""
    try:
        return do(services)
    except PasswordNeeded as error:
        if not from_stdin and not _is_watched():
            raise PasswordNeeded(f"{error}; give it with --password-stdin") from None
        given = password(f"Password of {services.actor.name}", from_stdin)
    return do(people.confirmed(services, given))


def _is_watched() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()
