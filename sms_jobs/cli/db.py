"""`sms db`: the catalogue's schema, its move to another database, and backups."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs import settings as settings_file
from sms_jobs.app import writing
from sms_jobs.catalogue import copying, schema, upkeep
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.jobs import backups
from sms_jobs.jobs.backups import Progress

app = typer.Typer(help="The catalogue's database, and backups.", no_args_is_help=True)

_FINDINGS = 6


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
            output.print_sentence(difference)
    if differences:
        raise typer.Exit(_FINDINGS)


@app.command()
def copy(
    to_url: Annotated[
        str,
        typer.Argument(
            help="An empty database: postgresql+psycopg://USER@HOST/NAME, or sqlite:////PATH. A password is "
            "better left to ~/.pgpass, or the whole URL to the environment variable, where nobody sees it.",
            envvar="SMS_COPY_TO_URL",
            show_default=False,
        ),
    ],
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Copy the whole catalogue to another database, for example from SQLite to PostgreSQL.

    The service must have ended. Nobody can write to the catalogue meanwhile. The target has all rows in the
    end, or none. Nothing is changed in the source, and the archive stays where it is.

    Example: sms db copy postgresql+psycopg://sms@db.example/sms
    """
    done = None
    with bootstrap.services(home) as services, closing(Catalogue(to_url, create=True)) as target:
        copying.require_idle(services.catalogue, datetime.now(UTC))
        copying.prepare(target)
        with output.progress_bar() as bar:
            task = bar.add_task("copying", total=None)
            for done in copying.copy(services.catalogue, target):
                bar.update(task, description=f"copying {done.table}", completed=done.done, total=done.total)
        upkeep.analyse(target)
        into = target.describe()
    rows = done.total if done else 0
    if as_json:
        output.print_json({"rows": rows, "to": into})
    output.say(
        f"copied {rows} rows to {into}; set database_url to it (in sms.toml, or SMS_DATABASE_URL) before "
        "anything is written to the old catalogue, then run 'sms doctor'"
    )


@app.command()
def backup(
    folder: Annotated[Path, typer.Argument(help="Where to; every backup adds to what is there.")],
    shares: Annotated[
        int, typer.Option(help="In how many backups all is read again; 1 for all of it now.", min=1)
    ] = backups.SHARES,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Back up the catalogue and the files of the archive that it knows, while the service runs.

    Copies are compared with what is on record. What an earlier backup has copied is not copied again; a share
    of it is read again, here and there, and damaged copies are replaced. Files of rigs and frames that are
    not archived yet come along; settings without URLs; logs do not. Files that are missing or damaged are
    listed; the exit code is then 6.

    Example: sms db backup /mnt/backup/sms
    """
    with bootstrap.services(home) as services:
        writing.new_folder(folder)
        steps = backups.back_up(
            services.catalogue, services.archive, services.settings, folder, datetime.now(UTC), shares
        )
        facts = _followed("backing up", steps)
    facts = {"snapshot": str(backups.snapshots(folder)[-1])} | facts
    _tell(facts, as_json)


@app.command()
def restore(
    folder: Annotated[Path, typer.Argument(help="Of the backup.")],
    home: Annotated[Path, typer.Argument(help="The home to be made; must be empty or not there.")],
    snapshot: Annotated[
        str, typer.Option(help="Beginning of its name, like 20260301; the newest if not given.")
    ] = "",
    host: Annotated[
        str, typer.Option(help="Whose rigs and frames come along, where several hosts backed up; this one's.")
    ] = "",
    as_json: Json = False,
) -> None:
    """Make a home of its own, without servers, of a backup.

    'sms archive verify' checks it; jobs that were running are recovered by 'sms up'; 'sms db copy' brings it
    to PostgreSQL.

    Example: sms db restore /mnt/backup/sms /data/sms-restored
    """
    home = home.expanduser().absolute()
    _tell(
        {"home": str(home)} | _followed("restoring", backups.restore(folder, home, snapshot, host)), as_json
    )


def _followed(what: str, steps: Iterator[Progress]) -> dict[str, Any]:
    """Show how work comes on, and return what came of it."""
    files = copied = again = total = 0
    findings = []
    with output.byte_bar() as bar:
        task = bar.add_task(what, total=None)
        for step in steps:
            bar.update(task, completed=step.done_bytes, total=step.total_bytes)
            files, copied, again = files + 1, copied + step.copied, again + step.read_again
            total = step.total_bytes or total
            if step.finding:
                findings.append({"path": step.path, "finding": step.finding})
    return {"files": files, "bytes": total, "copied": copied, "read_again": again, "findings": findings}


def _tell(facts: dict[str, Any], as_json: bool) -> None:
    findings = facts["findings"]
    if as_json:
        output.print_json(facts)
    else:
        output.print_facts({name: value for name, value in facts.items() if name != "findings"})
    if findings:
        if not as_json:
            output.print_table(["file", "what"], [tuple(one.values()) for one in findings], empty="")
        output.say(f"{len(findings)} files are missing or damaged; see 'sms archive verify' and the runbook")
        raise typer.Exit(_FINDINGS)
