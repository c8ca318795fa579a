"""`sms schedule`: jobs that are submitted at their time."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.app.work import schedules
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.cli import completion, output
from sms_jobs.cli.kind_options import given_parameters
from sms_jobs.cli.options import CampaignOption, NoCache, Priority
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput

app = typer.Typer(help="Schedules: jobs that are submitted at their time.", no_args_is_help=True)

Name = Annotated[str, typer.Argument(help="Name of the schedule.")]

Kinds: TypeAlias = Annotated[
    list[str],
    typer.Argument(help="Job kinds, or 'pipeline'.", autocompletion=completion.kind_names),
]
Where: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Instead of a campaign, the states that meet this question when it fires; see 'sms data states'."
    ),
]
Run: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Name of the run that the results belong to; --cron and --every add the time in UTC to it."
    ),
]
Cron: TypeAlias = Annotated[str | None, typer.Option(help="Minute, hour, day, month, weekday.")]
At: TypeAlias = Annotated[str | None, typer.Option(help="Once, at this time.")]
Every: TypeAlias = Annotated[str | None, typer.Option(help="Again and again, after 30s, 10m, 2h or 1d.")]
After: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Once, when all jobs of this campaign have ended.",
        autocompletion=completion.campaign_names,
    ),
]
Zone: TypeAlias = Annotated[
    str | None, typer.Option(help="IANA time zone of the times; this machine's if not given.")
]
Missed: TypeAlias = Annotated[
    Literal["skip", "once", "all"],
    typer.Option(help="Times that passed with no service running: skip them, run once, or run all."),
]
Grace: TypeAlias = Annotated[
    float, typer.Option(help="Seconds after which a time counts as missed.", min=1.0)
]
States: TypeAlias = Annotated[list[str] | None, typer.Option(help="Only this state; can be repeated.")]
Views: TypeAlias = Annotated[list[str] | None, typer.Option(help="Only this view; can be repeated.")]
Settings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--set", help="NAME=VALUE of the kind, or KIND.NAME=VALUE; can be repeated."),
]


@app.command()
def add(
    name: Name,
    kinds: Kinds,
    campaign: CampaignOption = None,
    where: Where = None,
    run: Run = None,
    cron: Cron = None,
    at: At = None,
    every: Every = None,
    after: After = None,
    zone: Zone = None,
    missed: Missed = "once",
    grace: Grace = 300,
    state: States = None,
    view: Views = None,
    parameter: Settings = None,
    priority: Priority = 0,
    no_cache: NoCache = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Submit jobs at a time, again and again, or when another campaign is done.

    Example: sms schedule add nightly pipeline -c wing-fatigue --cron "0 2 * * *" --zone Europe/London

    Example: sms schedule add again pipeline --where "time in 2025" --run today --at 2026-05-04T22:00
    """
    forms = {"cron": cron, "at": at, "every": every, "after": after}
    given = {form: what for form, what in forms.items() if what is not None}
    if len(given) != 1:
        raise InvalidInput(f"say when: one of --cron, --at, --every and --after, not {len(given)} of them")
    ((form, what),) = given.items()
    if (campaign is None) == (where is None):
        raise InvalidInput("say what of: a campaign with --campaign, or states with --where")
    views = tuple(view or ())
    work = Work(
        campaign or "",
        tuple(kinds),
        given_parameters(parameter or []),
        tuple(state or ()),
        views,
        priority,
        not no_cache,
        run,
    )
    now = datetime.now(UTC)
    with bootstrap.services(home) as services:
        first = schedules.add(
            services,
            name,
            f"{form} {what}",
            work,
            zone=zone,
            missed=missed,
            grace=timedelta(seconds=grace),
            where=where,
        )
    if as_json:
        output.print_json({"schedule": name, "next_fire": first})
    else:
        output.say(f"schedule {name} fires {_when(first, after, now)}; the service ('sms up') must run then")


def _when(first: datetime | None, after: str | None, now: datetime) -> str:
    """Say when a new schedule fires first."""
    if first is None:
        return f"when {after} is done"
    if first <= now:
        return f"at once, since {output.shown(first)} has only just passed"
    return f"next at {output.shown(first)}"


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show schedules, what became of them last, and when they fire next.

    Example: sms schedule list
    """
    with bootstrap.services(home) as services:
        found = schedules.list_schedules(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["schedule", "when", "zone", "campaign", "kinds", "last", "outcome", "next"],
        [
            (
                s.name,
                s.when,
                s.time_zone,
                s.campaign,
                " ".join(s.kinds),
                s.last_fire,
                output.with_options(s.last_outcome or ""),
                "paused" if s.paused else s.next_fire,
            )
            for s in found
        ],
        empty="there is no schedule; see 'sms schedule add --help'",
    )


@app.command("next")
def next_(
    name: Name,
    count: Annotated[int, typer.Option(help="How many times.", min=1, max=1000)] = 5,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show the next times of a schedule.

    Example: sms schedule next nightly --count 3
    """
    with bootstrap.services(home) as services:
        times = schedules.coming(services, name, count)
    if as_json:
        output.print_json({"schedule": name, "times": times})
        return
    for moment in times:
        output.print_sentence(output.shown(moment))
    if not times:
        output.say(f"schedule {name} has no time to come that is known; 'sms schedule list' shows it")


@app.command()
def pause(name: Name, home: Home = None) -> None:
    """Hold a schedule back.

    Example: sms schedule pause nightly
    """
    _set_paused(name, True, home)


@app.command()
def resume(name: Name, home: Home = None) -> None:
    """Let a schedule go on; times that passed meanwhile count as missed.

    Example: sms schedule resume nightly
    """
    _set_paused(name, False, home)


@app.command()
def remove(name: Name, home: Home = None) -> None:
    """Remove a schedule; jobs that it submitted stay.

    Example: sms schedule remove nightly
    """
    with bootstrap.services(home) as services:
        schedules.remove(services, name)
    output.say(f"removed schedule {name}")


def _set_paused(name: str, paused: bool, home: Path | None) -> None:
    with bootstrap.services(home) as services:
        schedules.set_paused(services, name, paused)
    output.say(f"schedule {name} {'is paused' if paused else 'goes on'}")
