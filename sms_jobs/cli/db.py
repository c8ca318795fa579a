"""`sms db`: the catalogue's schema, its move to another database, and backups."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app.home import database
from sms_jobs.app.home.database import SHARES, BackedUp
from sms_jobs.cli import bars, output
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sizes import number_of

app = typer.Typer(help="The catalogue's database, and backups.", no_args_is_help=True)

_FINDINGS = 6


@app.command()
def upgrade(home: Home = None) -> None:
    """Bring the catalogue to the schema that this version needs.

    Example: sms db upgrade
    """
    done = database.upgrade(home)
    output.say(f"the catalogue has revision {done.revision}" + (" already" if done.already else ""))


@app.command()
def check(home: Home = None, as_json: Json = False) -> None:
    """Compare the catalogue's schema with what this version needs.

    Example: sms db check --json
    """
    with bootstrap.services(home) as services:
        found = database.check(services)
    if as_json:
        output.print_json({"revision": found.revision, "differences": found.differences})
    else:
        for difference in found.differences or [f"revision {found.revision}, no difference"]:
            output.print_sentence(difference)
    if found.differences:
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
    with bootstrap.services(home) as services, bars.followed(bars.progress_bar()) as tell:
        done = database.copy(services, to_url, tell)
    if as_json:
        output.print_json({"rows": done.rows, "to": done.to})
    output.say(
        f"copied {number_of(done.rows, 'row')} to {done.to}; set database_url to it (in sms.toml, or "
        "SMS_DATABASE_URL) before anything is written to the old catalogue, then run 'sms doctor'"
    )


@app.command()
def backup(
    folder: Annotated[Path, typer.Argument(help="Where to; every backup adds to what is there.")],
    shares: Annotated[
        int, typer.Option(help="In how many backups all is read again; 1 for all of it now.", min=1)
    ] = SHARES,
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
    with bootstrap.services(home) as services, bars.followed(bars.byte_bar()) as tell:
        snapshot, done = database.back_up(services, folder, shares, tell)
    _tell({"snapshot": str(snapshot)}, done, as_json)


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
    with bars.followed(bars.byte_bar()) as tell:
        done = database.restore(folder, home, snapshot, host, tell)
    _tell({"home": str(home)}, done, as_json)


def _tell(facts: dict[str, Any], done: BackedUp, as_json: bool) -> None:
    facts |= {
        "files": done.files,
        "bytes": done.size_bytes,
        "copied": done.copied,
        "read_again": done.read_again,
    }
    if as_json:
        output.print_json(facts | {"findings": done.findings})
    else:
        output.print_facts(facts)
    if done.findings:
        if not as_json:
            rows = [(one.path, one.finding) for one in done.findings]
            output.print_table(["file", "what"], rows, empty="")
        output.say(
            f"{len(done.findings)} files are missing or damaged; see 'sms archive verify' and the runbook"
        )
        raise typer.Exit(_FINDINGS)
