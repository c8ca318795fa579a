"""`sms data query`: questions that are asked again and again, under a name."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.holdings import finding
from sms_jobs.cli import found_files, output
from sms_jobs.cli.found_files import After, As, Columns, FindOptions, Limit, Out
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import SmsError

app = typer.Typer(help="Questions to the archive that are kept under a name.", no_args_is_help=True)


def _names(context: typer.Context, incomplete: str) -> list[str]:
    try:
        home = context.params.get("home")
        with bootstrap.services(home) as services:
            names = [query.name for query in finding.queries(services)]
    except SmsError:
        return []
    return [name for name in names if name.startswith(incomplete)]


Name = Annotated[
    str,
    typer.Argument(help="Name of a saved query; see 'sms data query list'.", autocompletion=_names),
]


@app.command()
def save(
    name: Annotated[str, typer.Argument(help="Letters, digits, - and _, like high-strain.")],
    text: Annotated[str, typer.Argument(help="The query, in quotation marks; see docs/query.md.")],
    force: Annotated[bool, typer.Option("--force", help="Replace a query of that name.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Keep a query under a name, if it can be asked.

    Example: sms data query save high-strain 'strain where max_principal > 1e-3'
    """
    with bootstrap.services(home) as services:
        kept = finding.save_query(services, name, text, replace=force)
    if as_json:
        output.print_json({"query": kept})
        return
    output.say(f"saved; run it with 'sms data query run {name}'")


@app.command("list")
def list_queries(home: Home = None, as_json: Json = False) -> None:
    """List the saved queries.

    Example: sms data query list
    """
    with bootstrap.services(home) as services:
        kept = finding.queries(services)
    if as_json:
        output.print_json_list(kept)
        return
    output.print_table(
        ["query", "text", "saved"],
        [(q.name, q.text, q.saved_at) for q in kept],
        empty="no query is saved yet",
    )


@app.command()
def run(
    name: Name,
    limit: Limit = 50,
    after: After = None,
    columns: Columns = None,
    form: As = None,
    out: Out = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Ask a saved query.

    Example: sms data query run high-strain --format csv --out high_strain.csv
    """
    found_files.tell(
        home,
        lambda services: finding.saved_question(services, name),
        FindOptions(finding.portion(columns, after, limit), form, out, force, as_json),
    )


@app.command()
def remove(name: Name, home: Home = None) -> None:
    """Forget a saved query.

    Example: sms data query remove high-strain
    """
    with bootstrap.services(home) as services:
        finding.remove_query(services, name)
    output.say(f"removed the query {name}")
