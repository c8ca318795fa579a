"""`sms queue`: hold back queues, and say which jobs come first."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from sms_jobs import bootstrap
from sms_jobs.app.work import queues
from sms_jobs.cli import output
from sms_jobs.cli.job import JobIds
from sms_jobs.cli.options import CampaignOption
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sizes import number_of

app = typer.Typer(help="Queues: what may begin, and in which order.", no_args_is_help=True)

Names = Annotated[
    list[str] | None, typer.Argument(help="Queues: cpu, io, acquisition; all if none is named.")
]


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the queues, how many jobs are in them, and which are paused.

    Example: sms queue list
    """
    with bootstrap.services(home) as services:
        found = queues.list_queues(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["queue", "queued", "running", "paused since", "why"],
        [(q.name, q.queued, q.running, q.paused_at, q.reason) for q in found],
        empty="",
    )


@app.command()
def pause(
    names: Names = None,
    reason: Annotated[str, typer.Option(help="Why; shown to everybody who asks.")] = "",
    home: Home = None,
) -> None:
    """Let no more jobs of some queues begin; what runs goes on.

    Example: sms queue pause cpu --reason "the rig needs the machine until 14:00"
    """
    with bootstrap.services(home) as services:
        paused = queues.pause(services, names or [], reason)
    output.say(f"paused {', '.join(paused)}; 'sms queue resume' lets them go on")


@app.command()
def resume(names: Names = None, home: Home = None) -> None:
    """Let the jobs of paused queues begin again.

    Example: sms queue resume cpu
    """
    with bootstrap.services(home) as services:
        resumed = queues.resume(services, names or [])
    output.say(f"resumed {', '.join(resumed) or 'nothing: no queue was paused'}")


@app.command()
def move(
    to: Annotated[Literal["front", "back"], typer.Argument(help="Where to.")],
    jobs: JobIds = None,
    campaign: CampaignOption = None,
    home: Home = None,
) -> None:
    """Bring jobs that have not begun before or behind all others.

    Example: sms queue move front 3f2a
    """
    with bootstrap.services(home) as services:
        count = queues.move(services, jobs or [], campaign, to)
    output.say(f"moved {number_of(count, 'job')} to the {to}")


@app.command()
def priority(
    value: Annotated[
        int, typer.Argument(help="Higher runs earlier; 0 is usual. Write -- before a negative.")
    ],
    jobs: JobIds = None,
    campaign: CampaignOption = None,
    home: Home = None,
) -> None:
    """Give jobs that have not begun another priority.

    Example: sms queue priority 10 --campaign wing-fatigue
    """
    with bootstrap.services(home) as services:
        count = queues.set_priority(services, jobs or [], campaign, value)
    output.say(f"gave {number_of(count, 'job')} the priority {value}")
