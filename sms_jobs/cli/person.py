"""`sms person`: people who have names here, and what they may do."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.accounts import openid, people
from sms_jobs.cli import asking, output
from sms_jobs.cli.asking import PasswordStdin, Reason
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.people import Role
from sms_jobs.records.shown.people import PersonView

app = typer.Typer(help="People: their names, roles and passwords.", no_args_is_help=True)

Name = Annotated[str, typer.Argument(help="Name of a person; see 'sms person list'.")]


@app.command()
def add(
    name: Annotated[str, typer.Argument(help="Name to come in by; the account's on this host, if any.")],
    role: Annotated[Role, typer.Option(help="What the person may do; see docs/people.md.")],
    no_password: Annotated[
        bool, typer.Option("--no-password", help="Only the account of that name lets the person in.")
    ] = False,
    password_stdin: PasswordStdin = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Give somebody a name; the first has to be an administrator.

    From then on every command acts for the person of the account's name. Other accounts may only look on, but
    for the one that owns the home.

    Example: sms person add anna --role administrator

    Example: sms person add ben --role analyst --no-password
    """
    with bootstrap.services(home) as services:
        given = None if no_password else asking.password(f"New password of {name}", password_stdin, new=True)
        done = people.add(services, name, role, given)
    _tell(done, f"{name} is {role.value} from now on", as_json)


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show who has a name here.

    Example: sms person list
    """
    with bootstrap.services(home) as services:
        found = people.list_people(services)
    if as_json:
        output.print_json_list(found)
        return
    now = datetime.now(UTC)
    output.print_table(
        ["name", "role", "may come in", "password", "since"],
        [
            (
                person.name,
                person.role,
                "yes" if person.active else "no",
                _password(person, now),
                person.created_at,
            )
            for person in found
        ],
        empty="nobody has a name here, and everybody who reaches the home may do everything",
    )


@app.command()
def role(
    name: Name,
    role: Annotated[Role, typer.Argument(help="What the person may do; see docs/people.md.")],
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Let somebody do more or less from now on.

    Example: sms person role ben metrologist
    """
    with bootstrap.services(home) as services:
        done = people.set_role(services, name, role)
    _tell(done, f"{name} is {role.value} from now on", as_json)


@app.command()
def password(
    name: Annotated[
        str | None, typer.Argument(help="Of whom; your own if not given.", show_default=False)
    ] = None,
    password_stdin: PasswordStdin = False,
    home: Home = None,
) -> None:
    """Set a password: your own, for which the old one is asked, or as an administrator somebody else's.

    The person's sessions end; tokens stay. With --password-stdin, your own old password is the first line,
    empty if there is none yet.

    Example: sms person password; sms person password ben
    """
    with bootstrap.services(home) as services:
        whose = name or services.actor.name
        old = None
        if whose == services.actor.name:
            old = asking.password("Old password (Enter if there is none yet)", password_stdin, empty=True)
        given = asking.password(f"New password of {whose}", password_stdin, new=True)
        people.set_password(services, whose, given, old)
    output.say(f"{whose} has a new password; sessions that were open have ended")


@app.command()
def identity(
    name: Name,
    subject: Annotated[
        str | None, typer.Argument(help="By which the identity provider knows the person; none to forget it.")
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Say by which subject the identity provider knows somebody, who then logs in to the console by it.

    Whom it knows and nobody has entered is refused with the subject that is to be entered.

    Example: sms person identity anna 248289761001
    """
    with bootstrap.services(home) as services:
        done = openid.set_identity(services, name, subject)
    _tell(done, f"{name} is {subject or 'nobody'} to the identity provider", as_json)


@app.command()
def off(name: Name, reason: Reason = None, home: Home = None, as_json: Json = False) -> None:
    """Let somebody come in no more; tokens and sessions end at once. What the person did stays in the audit.

    Example: sms person off ben --reason "left in June"
    """
    with bootstrap.services(home) as services:
        done = people.set_active(asking.because(services, reason), name, False)
    _tell(done, f"{name} may not come in any more", as_json)


@app.command()
def on(name: Name, home: Home = None, as_json: Json = False) -> None:
    """Let somebody come in again, by the password; tokens have to be made anew.

    It also unlocks an account that too many wrong passwords have locked.

    Example: sms person on ben
    """
    with bootstrap.services(home) as services:
        done = people.set_active(services, name, True)
    _tell(done, f"{name} may come in", as_json)


def _password(person: PersonView, now: datetime) -> str:
    if person.locked_until is not None and person.locked_until > now:
        return f"locked until {output.clock(person.locked_until, now)}"
    return "yes" if person.has_password else "none"


def _tell(person: PersonView, said: str, as_json: bool) -> None:
    if as_json:
        output.print_json({"person": person})
    else:
        output.say(said)
