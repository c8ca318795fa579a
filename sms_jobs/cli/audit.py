"""`sms audit`: who did what, and the proof that it is as it was written."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.accounts import audit
from sms_jobs.app.accounts.audit import Head
from sms_jobs.cli import output
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sizes import number_of
from sms_jobs.records.times import parsed_time

app = typer.Typer(help="The audit: who did what, and is it as it was written?", no_args_is_help=True)

_FINDINGS = 6


@app.command("list")
def list_(
    who: Annotated[str | None, typer.Option(help="Only by this person or account.")] = None,
    action: Annotated[
        str | None, typer.Option(help="Only this, as jobs.cancel, or all of a group, as jobs.")
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Only from this time on, with zone, as 2026-05-04T10:00:00+02:00.")
    ] = None,
    limit: Annotated[int, typer.Option(help="At most so many, the newest.", min=1, max=100_000)] = 50,
    after: Annotated[
        int | None, typer.Option(help="Only older ones than this number: go on after a list's last.", min=1)
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what was done, the newest first.

    Example: sms audit list --who anna --action calibrations

    Example: sms audit list --after 731504
    """
    start = None if since is None else parsed_time(since, "--since")
    with bootstrap.services(home) as services:
        found = audit.list_links(services, who=who, action=action, since=start, limit=limit, after=after)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["number", "time", "who", "role", "via", "from", "action", "with", "reason"],
        [
            (
                link.number,
                link.at,
                link.who,
                link.role,
                link.via,
                link.origin,
                link.action,
                json.dumps(link.arguments, ensure_ascii=False) if link.arguments else "",
                link.reason,
            )
            for link in found
        ],
        empty="nothing of that was done",
    )


@app.command()
def export(
    file: Annotated[Path, typer.Argument(help="File to write; ends in .csv, or in .jsonl for JSON lines.")],
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Write the whole audit to a file, the oldest first.

    Example: sms audit export audit-2026.csv
    """
    with bootstrap.services(home) as services:
        count = audit.export(services, file, force=force)
    if as_json:
        output.print_json({"file": file, "links": count})
    else:
        output.say(f"wrote {file}: {number_of(count, 'link')}")


@app.command()
def head(home: Home = None, as_json: Json = False) -> None:
    """Print number and digest of the last link, to be kept where whoever has the database has no access.

    Example: sms audit head
    """
    with bootstrap.services(home) as services:
        last = audit.head(services)
    if as_json:
        output.print_json({"number": last.number, "digest": last.digest})
    else:
        output.print_sentence(str(last))


@app.command()
def verify(
    head: Annotated[
        str | None,
        typer.Option(
            help="NUMBER:DIGEST that 'sms audit head' has printed; it has to be there still.",
            show_default=False,
        ),
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Prove that what was done, and what happened to jobs, is told as it was written.

    Every place where it is not is listed; the exit code is then 6. What cannot be noticed without --head:
    that somebody who may change the whole database has taken the last links away, or has computed the chain
    anew.

    Example: sms audit verify --head "$(cat /media/safe/audit-head)"
    """
    kept = None if head is None else Head.parse(head)
    with bootstrap.services(home) as services:
        done = audit.verify(services, kept)
    if as_json:
        output.print_json({"links": done.links, "events": done.events, "breaks": done.breaks})
    else:
        output.print_table(
            ["what"],
            [(sentence,) for sentence in done.breaks],
            empty=f"{number_of(done.links, 'link')} and {number_of(done.events, 'event')} of jobs: "
            "all as they were written",
        )
    if done.breaks:
        raise typer.Exit(_FINDINGS)
