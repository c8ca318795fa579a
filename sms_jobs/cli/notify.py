"""`sms notify`: who is told what by mail or webhook, and whether it has arrived."""

from __future__ import annotations

from typing import Annotated

import typer
from pydantic import SecretStr

from sms_jobs import bootstrap
from sms_jobs.app.accounts import notifications
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, SmsError
from sms_jobs.records.shown.notifications import TOPICS, Address, Topic

app = typer.Typer(help="Notifications by mail and webhook.", no_args_is_help=True)


def _names(context: typer.Context, incomplete: str) -> list[str]:
    try:
        with bootstrap.services(context.params.get("home")) as services:
            names = [found.name for found in notifications.subscriptions(services)]
    except SmsError:
        return []
    return [name for name in names if name.startswith(incomplete)]


Name = Annotated[str, typer.Argument(help="Name of the subscription.", autocompletion=_names)]


@app.command()
def add(
    name: Annotated[str, typer.Argument(help="Letters, digits, - and _, like night.")],
    mail: Annotated[str | None, typer.Option(help="Mailbox that is written to.")] = None,
    webhook: Annotated[
        str | None, typer.Option(help="Address of a web server that is called: https, or http on this host.")
    ] = None,
    on: Annotated[
        str,
        typer.Option(help=f"Topics, with commas between them: {', '.join(t.value for t in Topic)}; or all."),
    ] = "all",
    ask_secret: Annotated[
        bool, typer.Option("--ask-secret", help="Ask for the secret that signs, instead of making one.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Tell somebody what happens, by mail or webhook.

    Example: sms notify add night --mail ops@lab.example --on job-failed,queue-done
    """
    if (mail is None) == (webhook is None):
        raise InvalidInput("say where to: either --mail or --webhook")
    address = Address.mail(mail) if mail is not None else Address.webhook(webhook or "")
    given = SecretStr(typer.prompt("secret", hide_input=True, err=True)) if ask_secret else None
    with bootstrap.services(home) as services:
        secret = notifications.add(services, name, address, _topics(on), given)
    shown = None if secret is None or given is not None else secret.get_secret_value()
    if as_json:
        output.print_json({"subscription": name, "where": address.shown, "secret": shown})
        return
    output.say(f"{name} is told at {address.shown}; see whether it arrives with 'sms notify test {name}'")
    if shown is not None:
        output.say("this secret signs what is sent, and is not shown again:")
        output.print_sentence(shown)


def _topics(words: str) -> list[Topic]:
    if words == "all":
        return list(Topic)
    known = {topic.value: topic for topic in Topic}
    given = [word.strip() for word in words.split(",")]
    for word in given:
        if word not in known:
            raise InvalidInput(f"there is no topic '{word}'; choose among {', '.join(known)}, or all")
    return [known[word] for word in given]


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show who is told what.

    Example: sms notify list
    """
    with bootstrap.services(home) as services:
        found = notifications.subscriptions(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["name", "channel", "where", "topics", "since", "waiting", "given up"],
        [
            (s.name, s.channel, s.where, " ".join(s.topics), s.created_at, s.waiting, s.given_up)
            for s in found
        ],
        empty="nobody is told anything; see 'sms notify add --help'",
    )


@app.command()
def topics(as_json: Json = False) -> None:
    """Show what can be subscribed to.

    Example: sms notify topics
    """
    told = {topic.value: told.meaning for topic, told in TOPICS.items()}
    if as_json:
        output.print_json({"topics": told})
        return
    output.print_table(["topic", "is told when"], list(told.items()), empty="")


@app.command()
def remove(name: Name, home: Home = None) -> None:
    """Tell somebody nothing more, and forget what was sent there.

    Example: sms notify remove night
    """
    with bootstrap.services(home) as services:
        notifications.remove(services, name)
    output.say(f"{name} is told nothing more")


@app.command("test")
def send_test(name: Name, home: Home = None) -> None:
    """Send a message now, and say what happened.

    Example: sms notify test night
    """
    with bootstrap.services(home) as services:
        where = notifications.test(services, name)
    output.say(f"{where} has taken it")


@app.command()
def sent(
    name: Annotated[
        str | None, typer.Argument(help="Only to this subscription.", autocompletion=_names)
    ] = None,
    limit: Annotated[int, typer.Option(help="At most so many, the latest.", min=1, max=100_000)] = 50,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what was sent, what waits and what was given up, and why.

    Example: sms notify sent night
    """
    with bootstrap.services(home) as services:
        found = notifications.sent(services, name, limit=limit)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["to", "subject", "since", "state", "tries", "sent or next try", "why not"],
        [
            (s.subscription, s.subject, s.created_at, s.state, s.tries, s.sent_at or s.next_try_at, s.error)
            for s in found
        ],
        empty="nothing has been told yet",
    )
