"""`sms queue`: hold back queues, and say which jobs come first."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Literal

import typer
from sqlalchemy.orm import Session

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.cli import output
from sms_jobs.cli.job import Campaign, JobIds, named_jobs
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.jobs import queues
from sms_jobs.jobs.chosen import Chosen

app = typer.Typer(help="Queues: what may begin, and in which order.", no_args_is_help=True)

Names = Annotated[
    list[str] | None, typer.Argument(help="Queues: cpu, io, acquisition; all if none is named.")
]


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the queues, how many jobs are in them, and which are paused.

    Example: sms queue list
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        found = queues.queues(session)
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
    reason: Annotated[str, typer.Option(help="Why; shown to everybody who asks.")] = "paused by an operator",
    home: Home = None,
) -> None:
    """Let no more jobs of some queues begin; what runs goes on.

    Example: sms queue pause cpu --reason "the rig needs the machine until 14:00"
    """
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        wanted = _checked(session, names)
        for name in wanted:
            queues.pause(session, name, reason, datetime.now(UTC))
    output.say(f"paused {', '.join(wanted)}; 'sms queue resume' lets them go on")


@app.command()
def resume(names: Names = None, home: Home = None) -> None:
    """Let the jobs of paused queues begin again.

    Example: sms queue resume cpu
    """
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        wanted = _checked(session, names)
        resumed = [name for name in wanted if queues.resume(session, name)]
    if names and not resumed:
        raise Conflict(f"{', '.join(wanted)} was not paused; nothing was changed")
    output.say(f"resumed {', '.join(resumed) or 'nothing: no queue was paused'}")


@app.command()
def move(
    to: Annotated[Literal["front", "back"], typer.Argument(help="Where to.")],
    jobs: JobIds = None,
    campaign: Campaign = None,
    home: Home = None,
) -> None:
    """Bring jobs that have not begun before or behind all others.

    Example: sms queue move front 3f2a
    """
    with bootstrap.services(home) as services:
        some = _jobs(services, jobs, campaign)
        with services.catalogue.writing() as session:
            count = queues.move(session, some, to)
    output.say(f"moved {count} jobs to the {to}")


@app.command()
def priority(
    value: Annotated[
        int, typer.Argument(help="Higher runs earlier; 0 is usual. Write -- before a negative.")
    ],
    jobs: JobIds = None,
    campaign: Campaign = None,
    home: Home = None,
) -> None:
    """Give jobs that have not begun another priority.

    Example: sms queue priority 10 --campaign wing-fatigue
    """
    if abs(value) > queues.HIGHEST_PRIORITY:
        raise InvalidInput(
            f"a priority of {value} is beyond +-{queues.HIGHEST_PRIORITY}; give one between these"
        )
    with bootstrap.services(home) as services:
        some = _jobs(services, jobs, campaign)
        with services.catalogue.writing() as session:
            count = queues.set_priority(session, some, value)
    if not count:
        raise Conflict("these jobs have begun or ended already; nothing was changed")
    output.say(f"gave {count} jobs the priority {value}")


def _checked(session: Session, names: list[str] | None) -> list[str]:
    known = queues.known(session)
    unknown = [name for name in names or [] if name not in known]
    if unknown:
        raise InvalidInput(f"there is no queue '{unknown[0]}'; choose among {', '.join(known)}")
    return names or known


def _jobs(services: Services, jobs: list[str] | None, campaign: str | None) -> Chosen:
    if not jobs and campaign is None:
        raise InvalidInput("name the jobs, or a campaign with --campaign")
    return named_jobs(services, jobs or [], campaign)
