"""`sms archive`: is everything there and as it was sealed, and what is to be done where it is not?"""

from __future__ import annotations

import re
import time
from dataclasses import asdict
from datetime import timedelta
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.holdings import archive
from sms_jobs.cli import bars, completion, output
from sms_jobs.cli.asking import Reason, because
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.sizes import number_of, size

app = typer.Typer(help="The archive: is everything there, and as it was sealed?", no_args_is_help=True)

_FINDINGS = 6
_AGE = re.compile(r"(\d{1,5})([hdw])")
_UNITS = {"h": "hours", "d": "days", "w": "weeks"}


@app.command()
def verify(
    campaign: Annotated[
        str | None,
        typer.Option(
            "--campaign", "-c", help="Only files of this campaign.", autocompletion=completion.campaign_names
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Look at presence and size alone.")] = False,
    after: Annotated[
        int, typer.Option(help="Go on after the file of this number, where another run ended.", min=0)
    ] = 0,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Read every file of the archive and compare it with the catalogue, whose audit is verified too.

    Files that are missing, damaged, unknown to the catalogue, left behind by a job that has ended, or no part
    of an archive are listed, and where the chain of 'sms audit' is not as it was written; the exit code is
    then 6. It may be interrupted, and says how to go on.

    Example: sms archive verify --campaign wing-fatigue
    """
    last = after

    def passed(number: int) -> None:
        nonlocal last
        last = number

    with bootstrap.services(home) as services:
        try:
            with bars.followed(bars.byte_bar()) as tell:
                done = archive.verify(
                    services, campaign=campaign, quick=quick, after=after, tell=tell, passed=passed
                )
        except KeyboardInterrupt:
            output.say(f"interrupted; 'sms archive verify --after {last}' goes on from here")
            raise
    if as_json:
        output.print_json({"checked": done.files, "bytes": done.size_bytes, "findings": done.findings})
    else:
        output.print_table(
            ["problem", "file", "what"],
            [(f.problem, f.path, f.detail) for f in done.findings],
            empty=f"{number_of(done.files, 'file')}, {size(done.size_bytes)}: all as they were sealed",
        )
    if done.findings:
        raise typer.Exit(_FINDINGS)


@app.command()
def state(home: Home = None, as_json: Json = False) -> None:
    """Say when the files of each campaign were last compared with what was sealed, and how many are due.

    A file is due where it was never compared, or not for 90 days; 'sms archive verify' does so. The exit code
    is 6 where files were not as they were sealed when they were last looked at.

    Example: sms archive state
    """
    with bootstrap.services(home) as services:
        found = archive.state(services)
    if as_json:
        output.print_json(asdict(found))
    else:
        output.print_table(
            ["campaign", "files", "size", "due", "damaged", "longest ago", "last"],
            [
                (one.campaign, one.files, size(one.size_bytes), one.due, one.damaged, one.oldest, one.newest)
                for one in found.campaigns
            ],
            empty="there is no file yet",
        )
        if found.damaged:
            output.print_table(
                ["file", "problem", "path", "what", "looked at"],
                [(one.file, one.problem, one.path, one.detail, one.checked_at) for one in found.damaged],
                empty="",
            )
        output.say(
            f"{found.due} of {found.files} files are due after {found.due_days:g} days, "
            f"{size(found.due_bytes)}; 'sms archive verify' compares them"
        )
    if found.damaged:
        raise typer.Exit(_FINDINGS)


@app.command()
def reindex(
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be done, and change nothing.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Enter the files of the archive that the catalogue does not know: all, where it is empty or damaged.

    A catalogue that is empty or gone is made anew; one on SQLite that is damaged is set aside before.

    Campaigns, states, rigs, calibrations, measurements, results with their statistics and provenance, and
    the jobs that made them are restored from the files; queues, schedules, pins, runs, failed jobs and
    people are not, and the audit begins a new chain. Every file is read as a whole. Those that could not be
    entered are listed with the reason; the exit code is then 6. It may be interrupted and run again, and
    goes on.

    Example: sms init --home new; sms archive reindex --home new --dry-run
    """
    started = time.monotonic()
    with bootstrap.renewed(home, dry_run=dry_run) as (services, renewal):
        if renewal:
            output.say(renewal)
        with bars.followed(bars.progress_bar()) as tell:
            done = archive.reindex(services, dry_run=dry_run, tell=tell)
    bad = done.not_well
    took = time.monotonic() - started
    if as_json:
        output.print_json(
            {
                "files": len(done.files),
                "indexed": done.entered,
                "bytes": done.size_bytes,
                "seconds": took,
                "not_well": bad,
            }
        )
    else:
        if bad:
            rows = [(one.outcome, one.path, one.detail) for one in bad]
            output.print_table(["outcome", "file", "why"], rows, empty="")
        output.say(
            f"{done.entered} of {len(done.files)} unknown files {'would be' if dry_run else 'are now'} in "
            f"the catalogue ({size(done.size_bytes)} in {took:.1f} s)"
        )
    if bad:
        raise typer.Exit(_FINDINGS)


@app.command()
def repair(
    yes: Annotated[bool, typer.Option("--yes", help="Do it; without, only say what would be done.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Look at presence and size alone.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Verify the archive and mend what can be mended; nothing is ever deleted.

    Unknown files that are whole and the output of their job are indexed. All others, what is unfinished, no
    part of an archive, or a damaged result, is moved to '.set-aside' in it. What only a person can do is
    said: restore a measurement from a backup, or compute a result again. The exit code is 6 as long as
    something is to do.

    Example: sms archive repair; sms archive repair --yes
    """
    with bootstrap.services(home) as services, bars.followed(bars.byte_bar()) as tell:
        done = archive.repair(services, dry_run=not yes, quick=quick, tell=tell)
    repairs, undone = done.repairs, done.undone
    if as_json:
        output.print_json({"done": yes, "repairs": repairs, "undone": undone})
    else:
        output.print_table(
            ["problem", "file", "is done" if yes else "would be done", "why", "then"],
            [(r.problem, r.path, r.step, r.why, r.then) for r in [*repairs, *undone]],
            empty="nothing is to be repaired",
        )
        if repairs and not yes:
            output.say("nothing was changed; 'sms archive repair --yes' does it")
    if undone or any(r.then for r in repairs) or (repairs and not yes):
        raise typer.Exit(_FINDINGS)


@app.command()
def gc(
    older_than: Annotated[str, typer.Option("--older-than", help="Age, such as 36h, 90d or 8w.")],
    kind: Annotated[
        list[str] | None,
        typer.Option(
            help="Only results of this kind; can be repeated.", autocompletion=completion.kind_names
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do it; without, only say what would go.")] = False,
    reason: Reason = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Remove old results that newer ones have replaced, and say how much room that gives.

    Measurements, calibrations, pinned files ('sms data pin'), results of kept runs ('sms run keep') and
    everything that a file which stays was computed from are never removed. Frames that recordings have left
    in this host's spool go when the recording was cancelled so long ago, or lies in the archive.

    Example: sms archive gc --older-than 90d --kind reconstruct --yes
    """
    age = _age(older_than)
    with bootstrap.services(home) as services:
        if yes:
            services = because(services, reason)
        gone = archive.remove_old(services, age, kind or (), dry_run=not yes)
    freed = gone.size_bytes
    if as_json:
        output.print_json({"done": yes, "files": gone.files, "frames": gone.frames, "bytes": freed})
        return
    rows: list[tuple[object, ...]] = [
        (g.file_id, g.kind, g.path, size(g.size_bytes), g.created_at) for g in gone.files
    ]
    rows += [
        ("", f"frames, {f.state.value}", str(f.path), size(f.size_bytes), f.ended_at) for f in gone.frames
    ]
    output.print_table(
        ["file", "kind", "path", "size", "created"],
        rows,
        empty="no result is old, replaced and needed by nothing; no frames are left of old recordings",
    )
    if rows:
        done = "removed" if yes else "would be removed; 'sms archive gc --yes' does it"
        output.say(f"{len(rows)} files and folders, {size(freed)}, {done}")


def _age(text: str) -> timedelta:
    found = _AGE.fullmatch(text)
    if found is None:
        raise InvalidInput(f"--older-than should be a number of hours, days or weeks like 90d, not '{text}'")
    return timedelta(**{_UNITS[found[2]]: int(found[1])})
