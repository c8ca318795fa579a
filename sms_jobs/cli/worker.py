"""`sms worker`: workers of a grown deployment."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs import inquiry, recovery

app = typer.Typer(help="Workers on this and other hosts.", no_args_is_help=True)

_SHOWN_FOR = timedelta(minutes=5)


@app.command()
def start(
    home: Home = None,
    queues: Annotated[
        str | None,
        typer.Option(help="Queues to serve, separated by commas; all of this host if not given."),
    ] = None,
) -> None:
    """Join the service on this host, serving some queues only, until Ctrl-C.

    A rig that `sms rig add` has connected to this host has a queue of its own, such as rig-wing; `rigs`
    stands for all of them, also for those that are connected later.

    Example: sms worker start --queues cpu,io,rigs
    """
    from sms_jobs.workers.celery_app import ALL_QUEUES
    from sms_jobs.workers.supervisor import Supervisor

    output.log_to_stderr()
    with bootstrap.services(home) as services:
        known = (*ALL_QUEUES, *services.stations.queues())
        wanted = ALL_QUEUES if queues is None else tuple(queue.strip() for queue in queues.split(","))
        unknown = [queue for queue in wanted if queue not in known]
        if unknown:
            raise InvalidInput(f"there is no queue '{unknown[0]}' here; choose among {', '.join(known)}")
        Supervisor(services, wanted).run()


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the workers that have lately given a sign of life.

    Example: sms worker list
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        workers = inquiry.workers(session, datetime.now(UTC) - _SHOWN_FOR)
    if as_json:
        output.print_json_list(workers)
        return
    output.print_table(
        ["worker", "host", "process", "queues", "jobs", "processes", "last beat", "draining", "held for"],
        [
            (
                *(w.id, w.host, w.pid, w.queues, w.running),
                *(f"{w.processes}/{w.concurrency}", w.beat_at, w.draining, w.held_for),
            )
            for w in workers
        ],
        empty="no worker is alive; start one with 'sms up'",
    )


@app.command()
def drain(worker: str, home: Home = None) -> None:
    """Let a worker finish what it runs and claim nothing more.

    Example: sms worker drain 1f3a
    """
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        known = inquiry.workers(session, datetime.now(UTC) - _SHOWN_FOR)
        matching = [w.id for w in known if worker and w.id.startswith(worker)]
        if len(matching) != 1:
            raise NotFound(f"there is no one worker '{worker}'; 'sms worker list' shows them")
        recovery.drain(session, matching[0])
    output.say(f"worker {matching[0]} claims no more jobs")
