"""`sms worker`: workers of a grown deployment."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.home import service
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json

app = typer.Typer(help="Workers on this and other hosts.", no_args_is_help=True)


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
    output.log_to_stderr()
    selected = None if queues is None else [queue.strip() for queue in queues.split(",")]
    with bootstrap.services(home) as services:
        service.supervisor(services, selected).run()


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the workers that have lately given a sign of life.

    Example: sms worker list
    """
    with bootstrap.services(home) as services:
        workers = service.workers(services)
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
    with bootstrap.services(home) as services:
        drained = service.drain(services, worker)
    output.say(f"worker {drained} claims no more jobs")
