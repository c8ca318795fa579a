"""`sms init`, `up` and `status`: the home and the service in it."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app.home import service
from sms_jobs.app.home.service import Status
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.waiting import outlook_text
from sms_jobs.errors import InvalidInput
from sms_jobs.records.sizes import number_of, size


def init(
    home: Home = None,
    environment_file: Annotated[
        Path | None,
        typer.Option(help="File with SMS_... variables, such as passwords; the home is not used without it."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a home: folder, settings file and an empty catalogue. What is there is kept.

    Example: sms init --home /data/sms
    """
    settings = bootstrap.initialise(home, environment_file)
    if as_json:
        output.print_json({"home": str(settings.home), "archive": str(settings.archive_root)})
    else:
        output.say(f"the home {settings.home} is ready; start the service with 'sms up'")


def up(
    home: Home = None,
    until_idle: Annotated[
        bool, typer.Option("--until-idle", help="End when no job is left that can run.")
    ] = False,
    web: Annotated[bool, typer.Option("--web", help="Serve the console, too, as 'sms serve' does.")] = False,
    listen: Annotated[
        str | None,
        typer.Option(
            help="Address and port of the console on this machine; that of 'sms serve' if not given."
        ),
    ] = None,
) -> None:
    """Serve: run queued jobs until Ctrl-C, which lets running jobs finish; twice kills them.

    Example: sms up --home /data/sms --web
    """
    # Which a status need not load.
    from sms_jobs.cli.serve import HERE, require_here

    if listen is not None and not web:
        raise InvalidInput(
            f"--listen {listen} is where the console would be: give --web, too, or leave it out"
        )
    require_here(listen or HERE)
    output.log_to_stderr()
    with bootstrap.services(home) as services:
        supervisor = service.supervisor(services)
        output.say(
            f"worker {supervisor.worker_id} serves {services.settings.home} with "
            f"{number_of(services.settings.workers, 'job')} at a time; Ctrl-C ends it"
        )
        with service.served(services, listen or HERE) if web else nullcontext():
            supervisor.run(until_idle=until_idle)


def status(home: Home = None, as_json: Json = False) -> None:
    """Show campaigns, jobs by state, workers and disk.

    Example: sms status --json
    """
    with bootstrap.services(home) as services:
        found = service.status(services)
    if as_json:
        output.print_json(_facts(found))
        return
    output.print_facts(
        {
            "home": found.home,
            "catalogue": found.catalogue,
            "archive": found.archive,
            "campaigns": found.campaigns,
            "jobs": ", ".join(f"{count} {state}" for state, count in found.jobs.items()) or "none",
            "workers": ", ".join(f"{w.id} on {w.host}" for w in found.workers)
            or "none; start one with 'sms up'",
            **_room(found),
        }
        | ({} if found.outlook is None else {"ahead": outlook_text(found.outlook)})
        | {f"next of {one.campaign}": f"{one.state}, {one.waits_for}" for one in found.planned}
    )


def _room(found: Status) -> dict[str, str]:
    """Return what is free of the archive and of the spool: once where they share a disk."""
    free = size(found.archive_free_bytes)
    if found.spool_free_bytes is None:
        return {"archive_free": f"{free}, shared with the spool"}
    return {"archive_free": free, "spool_free": size(found.spool_free_bytes)}


def _facts(found: Status) -> dict[str, Any]:
    workers = [
        {
            "id": w.id,
            "host": w.host,
            "pid": w.pid,
            "processes": w.processes,
            "running": w.running,
            "beat_at": w.beat_at,
        }
        for w in found.workers
    ]
    return {**vars(found), "workers": workers}
