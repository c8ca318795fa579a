"""`sms archive`: is everything there and as it was sealed, and what is to be done where it is not?"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer
from rich.progress import Progress

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import upkeep
from sms_jobs.cli import completion, output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs import left_frames, reindexing, retention, verification
from sms_jobs.jobs import repair as repairing
from sms_jobs.jobs.reindexing import Reindexed
from sms_jobs.jobs.verification import Checked, Finding
from sms_jobs.kinds import kind_named

app = typer.Typer(help="The archive: is everything there, and as it was sealed?", no_args_is_help=True)

_FINDINGS = 6
_AGE = re.compile(r"(\d{1,5})([hdw])")
_UNITS = {"h": "hours", "d": "days", "w": "weeks"}
_ENTERED = ("indexed", "incomplete")


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
    """Read every file of the archive and compare it with the catalogue.

    Files that are missing, damaged, unknown to the catalogue, left behind by a job that has ended, or no part
    of an archive are listed; the exit code is then 6. It may be interrupted, and says how to go on.

    Example: sms archive verify --campaign wing-fatigue
    """
    last = after
    findings: list[Finding] = []
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            wanted = verification.extent(session, after, campaign)
        try:
            with output.byte_bar() as bar:
                for done in _checked(services, bar, wanted.size_bytes, after, campaign, quick):
                    last = done.file_id
                    if done.finding is not None:
                        findings.append(done.finding)
        except KeyboardInterrupt:
            output.say(f"interrupted; 'sms archive verify --after {last}' goes on from here")
            raise
        if campaign is None:
            findings += verification.check_unknown(services.catalogue, services.archive)
    if as_json:
        output.print_json({"checked": wanted.files, "bytes": wanted.size_bytes, "findings": findings})
    else:
        output.print_table(
            ["problem", "file", "what"],
            [(f.problem, f.path, f.detail) for f in findings],
            empty=f"{wanted.files} files, {output.size(wanted.size_bytes)}: all as they were sealed",
        )
    if findings:
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

    Campaigns, states, rigs, calibrations, measurements, results with their statistics and provenance, and the
    jobs that made them are told by the files; queues, schedules, pins and failed jobs are not. Every file is
    read as a whole. Those that could not be entered are listed with the reason; the exit code is then 6. It
    may be interrupted and run again, and goes on.

    Example: sms init --home new; sms archive reindex --home new --dry-run
    """
    started = time.monotonic()
    done: list[Reindexed] = []
    with bootstrap.renewed(home, dry_run=dry_run) as (services, renewal):
        if renewal:
            output.say(renewal)
        paths = reindexing.unknown_files(services.catalogue, services.archive)
        with output.progress_bar() as bar:
            task = bar.add_task("reindexing", total=len(paths))
            for one in reindexing.reindex(services.catalogue, services.archive, paths, dry_run=dry_run):
                done.append(one)
                bar.advance(task)
        if done and not dry_run:
            upkeep.analyse(services.catalogue)
    bad = [one for one in done if one.outcome != "indexed"]
    size, entered = sum(one.size_bytes for one in done), sum(one.outcome in _ENTERED for one in done)
    took = time.monotonic() - started
    if as_json:
        output.print_json(
            {"files": len(done), "indexed": entered, "bytes": size, "seconds": took, "not_well": bad}
        )
    else:
        if bad:
            rows = [(one.outcome, one.path, one.detail) for one in bad]
            output.print_table(["outcome", "file", "why"], rows, empty="")
        output.say(
            f"{entered} of {len(done)} unknown files {'would be' if dry_run else 'are now'} in the catalogue "
            f"({output.size(size)} in {took:.1f} s)"
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
    with bootstrap.services(home) as services:
        catalogue, archive = services.catalogue, services.archive
        with catalogue.reading() as session:
            wanted = verification.extent(session)
        with output.byte_bar() as bar:
            checked = _checked(services, bar, wanted.size_bytes, 0, None, quick)
            findings = [done.finding for done in checked if done.finding is not None]
        findings += verification.check_unknown(catalogue, archive)
        repairs = repairing.planned(catalogue, archive, findings)
        undone = repairing.apply(catalogue, archive, repairs, datetime.now(UTC)) if yes else []
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
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Remove old results that newer ones have replaced, and say how much room that gives.

    Measurements, calibrations, pinned files ('sms data pin') and everything that a file which stays was
    computed from are never removed. Frames that recordings have left in this host's spool go when the
    recording was cancelled so long ago, or lies in the archive.

    Example: sms archive gc --older-than 90d --kind reconstruct --yes
    """
    age, kinds, now = _age(older_than), [kind_named(name).name for name in kind or []], datetime.now(UTC)
    with bootstrap.services(home) as services:
        spool = services.settings.spool_folder
        if yes:
            gone = retention.remove(services.catalogue, services.archive, now, age, kinds)
            frames = left_frames.remove(services.catalogue, spool, now, age, kinds)
        else:
            with services.catalogue.reading() as session:
                gone = retention.removable(session, now, age, kinds)
                frames = left_frames.removable(session, spool, now, age, kinds)
    freed = sum(g.size_bytes for g in gone) + sum(f.size_bytes for f in frames)
    if as_json:
        output.print_json({"done": yes, "files": gone, "frames": frames, "bytes": freed})
        return
    rows: list[tuple[object, ...]] = [
        (g.file_id, g.kind, g.path, output.size(g.size_bytes), g.created_at) for g in gone
    ]
    rows += [
        ("", f"frames, {f.state.value}", str(f.path), output.size(f.size_bytes), f.ended_at) for f in frames
    ]
    output.print_table(
        ["file", "kind", "path", "size", "created"],
        rows,
        empty="no result is old, replaced and needed by nothing; no frames are left of old recordings",
    )
    if rows:
        done = "removed" if yes else "would be removed; 'sms archive gc --yes' does it"
        output.say(f"{len(rows)} files and folders, {output.size(freed)}, {done}")


def _age(text: str) -> timedelta:
    found = _AGE.fullmatch(text)
    if found is None:
        raise InvalidInput(f"--older-than should be a number of hours, days or weeks like 90d, not '{text}'")
    return timedelta(**{_UNITS[found[2]]: int(found[1])})


def _checked(
    services: Services, bar: Progress, size: int, after: int, campaign: str | None, quick: bool
) -> Iterator[Checked]:
    task = bar.add_task("verifying", total=max(size, 1))
    for done in verification.check_known(
        services.catalogue, services.archive, after=after, campaign=campaign, quick=quick
    ):
        bar.advance(task, done.size_bytes)
        yield done
