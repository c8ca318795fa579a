"""`sms db`: the catalogue's schema."""

from __future__ import annotations

import typer

from sms_jobs import bootstrap
from sms_jobs import settings as settings_file
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json

app = typer.Typer(help="The catalogue's database.", no_args_is_help=True)


@app.command()
def upgrade(home: Home = None) -> None:
    """Bring the catalogue to the schema that this version needs.

    Example: sms db upgrade
    """
    catalogue = Catalogue(settings_file.load(home).catalogue_url)
    before = schema.current_revision(catalogue)
    schema.upgrade(catalogue)
    after = schema.current_revision(catalogue)
    output.say(f"the catalogue has revision {after}" + ("" if before != after else " already"))


@app.command()
def check(home: Home = None, as_json: Json = False) -> None:
    """Compare the catalogue's schema with what this version needs.

    Example: sms db check --json
    """
    with bootstrap.services(home) as services:
        differences = schema.differences_from_models(services.catalogue)
        revision = schema.current_revision(services.catalogue)
    if as_json:
        output.print_json({"revision": revision, "differences": differences})
    else:
        for difference in differences or [f"revision {revision}, no difference"]:
            output.answer.print(difference, markup=False)
    if differences:
        raise typer.Exit(6)
