"""`sms acquire stream`: cameras without a projector at a rate, and their frames as states."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.app.measuring import recordings, streams
from sms_jobs.app.measuring.recordings import Started
from sms_jobs.app.measuring.streams import Task
from sms_jobs.bootstrap import Services
from sms_jobs.cli import output, waiting
from sms_jobs.cli.options import CampaignArgument, NoWait
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, JobFailed
from sms_jobs.records.events import typed_event
from sms_jobs.records.numbers import checked_number
from sms_jobs.records.shown.streams import StreamOutcome, StreamRehearsal
from sms_jobs.records.sizes import number_of, size
from sms_jobs.records.units import duration_s, typed

_FINDINGS = 6
_LONGEST_S = 7 * 86400.0
_LONGEST_AROUND_S = 3600.0
_FASTEST_HZ = 1e4

Rate: TypeAlias = Annotated[str, typer.Option(help="Frames of each camera a second, such as 20Hz.")]
For: TypeAlias = Annotated[
    str,
    typer.Option("--for", help="How long, such as 30s; with --around, how long the event is waited for."),
]
Around: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Keep the frames around this event: 'load_n > 20kN', 'load_n < 1kN' or 'load_n drops 2kN in "
        "1s'. All are kept if not given.",
        show_default=False,
    ),
]
Before: TypeAlias = Annotated[
    str | None, typer.Option(help="What is kept before the event, such as 5s.", show_default=False)
]
After: TypeAlias = Annotated[
    str | None, typer.Option(help="What is kept after the event, such as 5s.", show_default=False)
]
Every: TypeAlias = Annotated[
    int,
    typer.Option(
        help="Make a state of every so manyth frame; those between are kept beside it.",
        min=1,
        max=100_000,
    ),
]
Cameras: TypeAlias = Annotated[
    str | None,
    typer.Option(help="Names of the cameras, such as C1,C2; those of the campaign if not given."),
]
NewRig: TypeAlias = Annotated[
    str | None, typer.Option(help="Make the campaign, for this rig, where there is none of its name.")
]
NewViews: TypeAlias = Annotated[
    str | None,
    typer.Option(help="Views of a campaign that is made, such as 'C1C2', or 'C1 C2' for each camera alone."),
]
Process: TypeAlias = Annotated[
    bool, typer.Option("--process", help="Process the campaign when its frames are there.")
]
DryRun: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--dry-run",
        help="Record nothing; show what it takes of memory and disks, and what is missing for it. Exit "
        "code 6 when something is.",
    ),
]


def stream(
    campaign: CampaignArgument,
    rate: Rate,
    for_: For,
    around: Around = None,
    before: Before = None,
    after: After = None,
    every: Every = 1,
    cameras: Cameras = None,
    rig: NewRig = None,
    views: NewViews = None,
    process: Process = False,
    no_wait: NoWait = False,
    dry_run: DryRun = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Record cameras without a projector at a rate; each frame becomes a state, with its time and its load.

    States are labelled t0001, t0002, ...; those of the campaign's second stream t2-0001. What the channels of
    the rig read when a frame was exposed is on record with it. Exit code 5 when it needs an operator.

    Example: sms acquire stream wing --rate 20Hz --for 30s --process

    Example: sms acquire stream wing --rate 50Hz --around 'load_n > 20kN' --before 5s --after 5s --for 2h

    Example: sms acquire stream coupon --cameras C1,C2 --rig pair --rate 5Hz --for 10min --dry-run
    """
    task = _task(campaign, rate, for_, around, before, after, every, cameras, rig, views)
    with bootstrap.services(home) as services:
        if dry_run:
            _show(campaign, streams.rehearse(services, task), as_json)
            return
        begun = streams.begin(services, task)
        if no_wait:
            if as_json:
                output.print_json({"campaign": campaign, "jobs": begun.job_ids})
            return
        _follow(services, campaign, begun, as_json)
        if process:
            count = recordings.process(services, campaign)
            if not as_json:
                output.say(f"submitted {number_of(count, 'job')} of the pipeline")


def _task(
    campaign: str,
    rate: str,
    for_: str,
    around: str | None,
    before: str | None,
    after: str | None,
    every: int,
    cameras: str | None,
    rig: str | None,
    views: str | None,
) -> Task:
    """Return what is asked for; raise `InvalidInput` for what is none, or does not go together."""
    if (around is None) is not (before is None and after is None):
        raise InvalidInput(
            "--before and --after go with --around 'load_n > 20kN', and say what is kept: give them together"
        )
    rate_hz = typed(rate, "--rate").in_unit("Hz", "--rate")
    checked_number(rate_hz, "--rate in Hz", 1e-4, _FASTEST_HZ)
    return Task(
        campaign,
        rate_hz,
        duration_s(for_, "--for", 1e-3, _LONGEST_S),
        None if around is None else typed_event(around, "--around"),
        0.0 if before is None else duration_s(before, "--before", 0.0, _LONGEST_AROUND_S),
        0.0 if after is None else duration_s(after, "--after", 0.0, _LONGEST_AROUND_S),
        every,
        tuple(name.strip() for name in cameras.split(",")) if cameras else (),
        rig,
        views,
    )


def _show(campaign: str, found: StreamRehearsal, as_json: bool) -> None:
    """Print what a stream would take; end with 6 when something is missing."""
    if as_json:
        output.print_json({"campaign": campaign, **vars(found)})
    else:
        output.print_facts(
            {
                "cameras": ", ".join(found.cameras),
                "kept": f"{output.duration(found.seconds)}: {number_of(found.frames, 'frame')} a camera",
                "states": str(found.states),
                "memory": f"{size(found.ring_bytes)}, of {size(found.memory_room)}",
                "spool": f"{size(found.spool_bytes)} at most, of {size(found.spool_room)}",
                "archived": f"{size(found.archived_bytes)} at most, of {size(found.archive_room)}",
            }
        )
        for words in found.missing:
            output.say(words)
    if found.missing:
        raise typer.Exit(_FINDINGS)


def _follow(services: Services, campaign: str, begun: Started, as_json: bool) -> None:
    """Wait for a stream and say what came of it; raise `JobFailed` when it did not succeed."""
    with waiting.followed(stop="sms acquire abort") as tell:
        done = streams.wait_for_stream(services, begun, tell)
    if as_json:
        output.print_json({"campaign": campaign, "jobs": begun.job_ids, **vars(done.outcome)})
    elif done.outcome.first:
        _tell(campaign, done.outcome)
    if done.waited.failures:
        raise JobFailed(f"the stream of {campaign} did not succeed; {done.waited.failure}")


def _tell(campaign: str, found: StreamOutcome) -> None:
    output.print_table(
        ["camera", "exposed", "not delivered", "no room in memory", "too late", "whole", "states", "doubted"],
        [
            (name, c.moments, c.lost, c.refused, c.late, c.whole, c.states, c.doubted)
            for name, c in found.cameras.items()
        ],
        empty="nothing was recorded",
    )
    rate = "" if found.rate_hz is None else f", {found.rate_hz:.3g} a second"
    output.say(f"{campaign} has the states {found.first} to {found.last}{rate}")
    for name, (low, high) in found.channels.items():
        output.say(f"{name} went from {low:g} to {high:g}")
    for name, count in found.unread.items():
        output.say(
            f"{name} was not read before and after {number_of(count, 'state')}, which it has no value for: "
            "see that its software writes, and 'sms import channels' to enter it"
        )
    if found.broke_off:
        output.say("the stream broke off; what had been written by then is in the archive")
