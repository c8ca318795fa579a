"""`sms run`: named runs, and what differs between two."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.app.work import runs
from sms_jobs.cli import bars, completion, output
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.job import SHORT_ID
from sms_jobs.records.plain import plain
from sms_jobs.records.shown.runs import Difference, RunChange, RunComparison, RunStory
from sms_jobs.records.sizes import number_of

app = typer.Typer(help="Runs: results under a name, kept and compared.", no_args_is_help=True)

_MOST_TOLD = 20

Name = Annotated[str, typer.Argument(help="Name of the run.", autocompletion=completion.run_names)]
Limit = Annotated[int, typer.Option(help="At most so many rows.", min=1, max=100_000)]


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the runs, the newest first.

    Example: sms run list
    """
    with bootstrap.services(home) as services:
        found = runs.list_runs(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["run", "begun", "by", "campaigns", "submissions", "jobs", "kept"],
        [
            (
                one.name,
                one.created_at,
                one.created_by,
                ", ".join(one.campaigns),
                one.submissions,
                _counted(one.jobs),
                "" if one.kept_at is None else one.reason or "yes",
            )
            for one in found
        ],
        empty="there is no run; name one with 'sms job submit ... --run NAME'",
    )


@app.command()
def show(name: Name, limit: Limit = 50, home: Home = None, as_json: Json = False) -> None:
    """Show what a run names: results, with what was asked for and the calibrations that were used.

    Results that an earlier job had made already belong to a run as well. With --json, with all parameters
    and inputs.

    Example: sms run show wider-subsets
    """
    with bootstrap.services(home) as services:
        found = runs.show(services, name)
    if as_json:
        output.print_json({"run": found.run} | _story(found))
        return
    asked = ", ".join(f"{key}={value}" for key, value in found.parameters.items())
    output.print_facts(
        {
            "run": found.run.name,
            "begun": found.run.created_at,
            "by": found.run.created_by,
            "campaigns": ", ".join(found.run.campaigns),
            "parameters": asked or "nothing but the defaults",
            "jobs": _counted(found.run.jobs),
            "kept": "no" if found.run.kept_at is None else found.run.reason or "yes",
        }
    )
    output.print_table(
        ["kind", "subject", "version", "job", "reused", "files", "calibrations"],
        [
            (
                one.kind,
                one.subject,
                one.version,
                one.job[:SHORT_ID],
                "" if one.made_by == one.job else f"from {one.made_by[:SHORT_ID]}",
                ", ".join(map(str, one.files)) or "removed",
                ", ".join(map(str, one.calibrations)),
            )
            for one in found.results[:limit]
        ],
        empty="it names no result yet",
    )
    _tell_more(len(found.results), limit, "results")
    for about, state in list(found.missing.items())[:_MOST_TOLD]:
        output.say(f"no result yet: {about} is {state}")
    _tell_more(len(found.missing), _MOST_TOLD, "without a result yet")


def _story(found: RunStory) -> dict[str, Any]:
    return {"parameters": found.parameters, "results": found.results, "missing": found.missing}


@app.command()
def compare(
    before: Name,
    after: Annotated[str, typer.Argument(help="Name of the other.", autocompletion=completion.run_names)],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .html for a page with maps, .csv for numbers."),
    ] = None,
    force: Force = False,
    limit: Limit = 50,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what was not the same in two runs, and by how much displacement, strain and gauges differ.

    Differences are after minus before, over the pixels that have a value in both. The last column is the part
    of them that changed by more than twice the standard deviation of their difference, as if both results had
    noise of their own: those of the same images share it, and more may have changed.

    Example: sms run compare today wider-subsets -o page.html
    """
    if out is not None:
        writing.check_new_file(out, force, (".html", ".csv"))
    # Listing and keeping runs needs nothing of what reads fields.
    from sms_jobs.app.work import run_comparison

    with bootstrap.services(home) as services, bars.followed(bars.progress_bar()) as tell:
        if out is not None and out.suffix == ".html":
            page = run_comparison.compare_runs_page(services, before, after, tell=tell)
            found, content = page.comparison, page.html
        else:
            found = run_comparison.compare_runs(services, before, after, tell=tell)
            content = run_comparison.table(found)
    if out is not None:
        writing.write_file(out, content.encode(), force)
        output.say(f"wrote {out}")
    if as_json:
        output.print_json(plain(found))
        return
    _tell_changes(found)
    output.print_table(
        [
            "subject",
            "quantity",
            "unit",
            "points",
            "gained",
            "lost",
            "rms",
            "median",
            "largest",
            "stated",
            "> 2 sigma [%]",
        ],
        [_row(one) for one in found.differences[:limit]],
        empty="no displacement, strain or gauge differs",
    )
    _tell_more(len(found.differences), limit, "differences")
    _tell_rest(found)


def _tell_changes(found: RunComparison) -> None:
    output.print_table(
        ["changed", "of", f"in {found.before}", f"in {found.after}", "results", "asked for"],
        [
            (
                one.what,
                f"{one.kind}.{one.name}".strip("."),
                _value(one.before),
                _value(one.after),
                one.results,
                "yes" if one.intended else "no",
            )
            for one in found.changes
        ],
        empty="parameters, inputs, calibrations and versions are the same",
    )
    for one in found.unasked[:_MOST_TOLD]:
        output.say(f"warning: {_unasked(one)} changed, which nobody asked for")


def _unasked(one: RunChange) -> str:
    what = "the campaign's definition" if one.what == "definition" else f"the {one.what}"
    of = f"{one.kind}.{one.name}".strip(".")
    return f"{what} {'for ' if one.what == 'definition' else ''}{of}".strip()


def _value(value: Any) -> str | None:
    return None if value is None else str(value)


def _row(one: Difference) -> Sequence[Any]:
    beyond = None if one.beyond is None else 100.0 * one.beyond
    counts = (one.points, one.gained, one.lost)
    lengths = (one.rms, one.median, one.largest, one.sigma)
    return (one.subject, one.quantity, one.unit, *counts, *lengths, beyond)


def _tell_rest(found: RunComparison) -> None:
    if found.same:
        output.say(f"the same in both: {number_of(found.same, 'result')} of displacement, strain and gauges")
    for name, alone in ((found.before, found.only_before), (found.after, found.only_after)):
        if alone:
            output.say(f"only {name} has {', '.join(f'{count} {kind}' for kind, count in alone.items())}")
    for why in found.unlike[:_MOST_TOLD]:
        output.say(f"not subtracted: {why}")
    _tell_more(len(found.unlike), _MOST_TOLD, "not subtracted")


@app.command()
def keep(
    name: Name,
    reason: Annotated[str, typer.Option(help="Why it is kept.")] = "",
    home: Home = None,
) -> None:
    """Keep what a run names, and all that it was computed from, whatever `sms archive gc` is asked to remove.

    Nothing is added to it from then on. `sms run drop` lets go of it again.

    Example: sms run keep wider-subsets --reason "figure 4 of the paper"
    """
    with bootstrap.services(home) as services:
        found = runs.keep(services, name, reason)
    gone = f", {found.removed} of which had been removed before" if found.removed else ""
    output.say(f"run {name} is kept: {number_of(len(found.results), 'result')}{gone}")


@app.command()
def drop(
    name: Name,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    home: Home = None,
) -> None:
    """Forget the name of a run: its jobs, results and measurements stay.

    Results that newer ones have replaced may then be removed by `sms archive gc`.

    Example: sms run drop wider-subsets --yes
    """
    with bootstrap.services(home) as services:
        found = runs.show(services, name).run
        kept = "" if found.kept_at is None else ", which is kept,"
        if not yes:
            if not sys.stdin.isatty():
                raise InvalidInput(f"to drop run '{name}'{kept} has to be confirmed; give --yes")
            typer.confirm(
                f"Forget the name of run '{name}'{kept} and keep its results?", abort=True, err=True
            )
        runs.drop(services, name)
    output.say(f"run {name} is dropped; its results stay")


def _counted(jobs: Any) -> str:
    return ", ".join(f"{count} {state}" for state, count in jobs.items()) or "none"


def _tell_more(count: int, limit: int, what: str) -> None:
    if count > limit:
        output.say(f"{count - limit} more {what}; --json tells of all")
