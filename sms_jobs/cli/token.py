"""`sms token`: what lets programs in for a person."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json

app = typer.Typer(help="Tokens: what lets programs in for a person.", no_args_is_help=True)


@app.command()
def create(
    label: Annotated[str, typer.Argument(help="What it is for.")],
    days: Annotated[int, typer.Option(help="Until it ends.", min=1, max=people.LONGEST_TOKEN_DAYS)] = 90,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Make a token with which a program comes in as you, and print it: this once.

    Example: sms token create "nightly export" --days 30
    """
    with bootstrap.services(home) as services:
        made = people.create_token(services, label, days)
    if as_json:
        output.print_json(
            {"token": made.id, "label": made.label, "secret": made.secret, "expires_at": made.expires_at}
        )
        return
    output.print_sentence(made.secret)
    output.say(
        f"token {made.id} ends {output.shown(made.expires_at)}; whoever has it may do what you may, and it "
        "is not shown again"
    )


@app.command("list")
def list_(
    person: Annotated[
        str | None, typer.Option(help="Of somebody else; for administrators.", show_default=False)
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show the tokens and sessions that let you in.

    Example: sms token list; sms token list --person ben
    """
    with bootstrap.services(home) as services:
        found = people.list_access(services, person)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["id", "sort", "label", "since", "ends", "used"],
        [(one.id, one.sort, one.label, one.created_at, one.expires_at, one.used_at) for one in found],
        empty="there is no token and no session",
    )


@app.command()
def revoke(
    id_: Annotated[str, typer.Argument(metavar="ID", help="Of a token or session; see 'sms token list'.")],
    home: Home = None,
) -> None:
    """Let a token or a session let nobody in any more.

    Example: sms token revoke 3f2a9c0d11e47b58
    """
    with bootstrap.services(home) as services:
        gone = people.revoke(services, id_)
    output.say(f"{gone.sort} {gone.id} of {gone.person} lets nobody in any more")
