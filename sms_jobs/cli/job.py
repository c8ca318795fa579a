"""`sms job`: submit, follow and mend jobs.

What only some of its commands need is imported there: of all commands, `sms job list` is typed most.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.app.work import jobs as jobs_
from sms_jobs.cli import completion, output
from sms_jobs.cli.kind_options import CONTEXT, KindCommand, given_parameters, split_words
from sms_jobs.cli.options import CampaignOption, JobId, NoCache, Priority
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.waiting import as_json as outlook_as_json
from sms_jobs.cli.waiting import estimate_text, followed, outlook_text, remarks_as_json, tell_remarks
from sms_jobs.errors import InvalidInput
from sms_jobs.records.job import SHORT_ID, JobState
from sms_jobs.records.sizes import number_of, size

if TYPE_CHECKING:
    from sms_jobs.app.work.new_jobs import Refusal, Submitted, Work
    from sms_jobs.app.work.waiting import Waited, Waiting

_FINDINGS = 6
_MOST_REFUSED = 20
_NONE_ACTIVE = "no job is active"

app = typer.Typer(help="Jobs: submit, follow and mend them.", no_args_is_help=True)

JobIds = Annotated[
    list[str] | None,
    typer.Argument(help="Job ids, or the beginnings of them.", autocompletion=completion.job_ids),
]
Kinds: TypeAlias = Annotated[
    list[str],
    typer.Argument(
        help="Job kinds, or 'pipeline' for all but simulate; see 'sms job kinds'.",
        autocompletion=completion.kind_names,
    ),
]
Where: TypeAlias = Annotated[
    str | None,
    typer.Option(
        help="Instead of a campaign, the states that meet this question, across campaigns; see "
        "'sms data states'."
    ),
]
States: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(help="Only this state; can be repeated.", autocompletion=completion.state_labels),
]
Views: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(help="Only this view; can be repeated.", autocompletion=completion.view_names),
]
Settings: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="NAME=VALUE of the kind, or KIND.NAME=VALUE of the pipeline; can be repeated."
    ),
]
Run: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--run",
        help="Name of the run that the results belong to; see 'sms run --help'.",
        autocompletion=completion.run_names,
    ),
]
Wait: TypeAlias = Annotated[bool, typer.Option("--wait", help="Return when the jobs have ended.")]
DryRun: TypeAlias = Annotated[
    bool, typer.Option("--dry-run", help="Say what would be submitted and how long it would take.")
]


@app.command(cls=KindCommand, context_settings=CONTEXT)
def submit(
    kind: Kinds,
    campaign: CampaignOption = None,
    where: Where = None,
    state: States = None,
    view: Views = None,
    parameter: Settings = None,
    priority: Priority = 0,
    no_cache: NoCache = False,
    run: Run = None,
    wait: Wait = False,
    dry_run: DryRun = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Submit jobs for the tuples of a campaign, or of all that meet a question, and say when they end.

    A state whose jobs lack something, such as its recording, is left out and named with the reason; the
    others are submitted, and the exit code is 6. Where no state is left, nothing is submitted.

    The estimate comes from how long such jobs have taken before. Of a single kind, a parameter can be given
    like an option: `--help` after the kind shows them.

    Example: sms job submit pipeline -c wing-fatigue --dry-run

    Example: sms job submit pipeline -c wing-fatigue --set strain.gauge_length_mm=30

    Example: sms job submit pipeline -c wing --run wider-subsets --set correlate.subset_radius_px=14

    Example: sms job submit pipeline --where "time in 2025" --run today

    Example: sms job submit reconstruct --method fdr --returns 2 -c wing-fatigue
    """
    from sms_jobs.app.work import new_jobs, waiting

    if wait and dry_run:
        raise InvalidInput("--dry-run submits nothing that --wait could wait for; give one of them")
    if (campaign is None) == (where is None):
        raise InvalidInput("say what of: a campaign with --campaign, or states with --where")
    if where is not None and (wait or state):
        raise InvalidInput("--where chooses the states, and --wait is for one campaign; leave them out")
    kind, settings = split_words(kind)
    parameters = given_parameters([*settings, *(parameter or [])])
    views = tuple(view or ())
    work = new_jobs.Work(
        campaign or "", tuple(kind), parameters, tuple(state or ()), views, priority, not no_cache, run
    )
    with bootstrap.services(home) as services:
        if where is not None:
            _submit_found(services, where, work, dry_run, as_json)
            return
        done = new_jobs.submit(services, work, dry_run=dry_run)
        if as_json and (dry_run or not wait):
            output.print_json(_submitted_as_json(work.campaign, done, dry_run))
        elif not as_json:
            _tell_submitted(len(done.job_ids), done.counted, dry_run)
            if done.counted:
                output.say(estimate_text(done.estimate, datetime.now(UTC)))
        _tell_refused(done.refused)
        if wait and (done.counted or as_json):
            with followed(stop="sms job cancel") as tell:
                waited = waiting.wait_for(services, done.jobs, tell=tell)
            _tell_waited(waited, as_json)
    if done.refused:
        raise typer.Exit(_FINDINGS)


def _submit_found(services: bootstrap.Services, where: str, work: Work, dry_run: bool, as_json: bool) -> None:
    """Submit work of all campaigns with states that meet a question, and say what of each."""
    # Which loads what questions about states consist of.
    from sms_jobs.app.work import found_work

    found = found_work.submit_found(services, where, work, dry_run=dry_run)
    if as_json:
        told = [_submitted_as_json(name, done, dry_run) for name, done in found.campaigns.items()]
        output.print_json({"campaigns": told, "refused": found.refused})
    else:
        jobs = sum(len(done.job_ids) for done in found.campaigns.values())
        _tell_submitted(jobs, found.counted, dry_run)
        output.say(f"of {number_of(len(found.campaigns), 'campaign')}: {', '.join(found.campaigns)}")
    _tell_refused(found.all_refused)
    if found.all_refused:
        raise typer.Exit(_FINDINGS)


def _submitted_as_json(campaign: str, done: Submitted, dry_run: bool) -> dict[str, Any]:
    jobs = done.counted if dry_run else done.job_ids
    return {"campaign": campaign, "jobs": jobs, "estimate": done.estimate, "refused": done.refused}


def _tell_submitted(jobs: int, counted: Mapping[str, int], dry_run: bool) -> None:
    what = ", ".join(f"{count} {name}" for name, count in counted.items())
    would = "would submit" if dry_run else "submitted"
    output.say(f"{would} {number_of(jobs, 'job')}: {what}" if what else "there is nothing to do")


def _tell_refused(refused: Sequence[Refusal]) -> None:
    """Say which states are left out and why, as many as fit a screen."""
    for one in refused[:_MOST_REFUSED]:
        jobs = ", ".join(f"{count} {name}" for name, count in one.jobs.items())
        output.say(f"refused: {one.subject}{f' ({jobs})' if jobs else ''}: {one.why}")
    if len(refused) > _MOST_REFUSED:
        output.say(f"refused: {len(refused) - _MOST_REFUSED} more; --json tells of all")


@app.command()
def kinds(as_json: Json = False) -> None:
    """Show the job kinds and their parameters with defaults; as JSON, what they take and give as well.

    Example: sms job kinds
    """
    from sms_jobs.app.work.kinds import kinds as all_kinds

    found = all_kinds()
    if as_json:
        output.print_json_list(
            {
                "kind": kind.name,
                "version": kind.version,
                "per": kind.per,
                "summary": kind.summary,
                "inputs": kind.inputs,
                "outputs": kind.outputs,
                "parameters": {one.name: one.default for one in kind.parameters},
            }
            for kind in found
        )
        return
    output.print_table(
        ["kind", "per", "summary", "parameters"],
        [
            (k.name, k.per, k.summary, ", ".join(f"{one.name}={one.default}" for one in k.parameters))
            for k in found
        ],
        empty="there is no job kind: the installation is broken",
    )


@app.command("list")
def list_(
    campaign: CampaignOption = None,
    state: Annotated[list[JobState] | None, typer.Option(help="Only in this state; can be repeated.")] = None,
    kind: Annotated[str | None, typer.Option(help="Only of this kind.")] = None,
    limit: Annotated[int, typer.Option(help="At most so many, the latest.", min=1, max=100_000)] = 50,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show jobs, the latest first.

    Example: sms job list -c wing-fatigue --state failed
    """
    with bootstrap.services(home) as services:
        found = jobs_.list_jobs(services, campaign=campaign, states=state or (), kind=kind, limit=limit)
        if as_json:
            output.print_json_list(found)
            return
        left = None if campaign is None else jobs_.remaining(services, campaign)
    of_campaign = "" if campaign is None else f" of {campaign}"
    output.print_table(
        ["job", "kind", "subject", "by", "state", "%", "seconds", "message"],
        [
            (
                j.id[:SHORT_ID],
                j.kind,
                j.subject,
                j.submitted_by,
                j.state,
                f"{100 * j.progress:.0f}",
                j.seconds,
                j.message,
            )
            for j in found
        ],
        empty="there is no such job"
        if state or kind
        else f"there are no jobs{of_campaign} yet; 'sms job submit' makes some",
    )
    if left is not None and left.outlook is not None:
        jobs = (
            f"{number_of(left.active, 'job')} of {campaign} {'has' if left.active == 1 else 'have'} not ended"
        )
        output.say(f"{jobs}: {outlook_text(left.outlook)}")


@app.command()
def show(job: JobId, home: Home = None, as_json: Json = False) -> None:
    """Show a job, what has happened to it, and the files that it made.

    Example: sms job show 3f2a
    """
    with bootstrap.services(home) as services:
        found = jobs_.show(services, job)
    view = found.job
    if as_json:
        output.print_json({"job": view, "events": found.events, "files": found.files})
        return
    output.print_facts(
        {
            "job": view.id,
            "kind": view.kind,
            "subject": view.subject,
            "submitted by": view.submitted_by,
            "state": view.state,
            "message": view.message,
            "parameters": ", ".join(f"{n}={v}" for n, v in view.parameters.items()),
            "attempts": view.attempts,
            "seconds": view.seconds,
        }
    )
    output.print_table(
        ["time", "state", "attempt", "message"],
        [(e.at, e.state, e.attempt, e.message) for e in found.events],
        empty="",
    )
    output.print_table(
        ["file", "subject", "size", "path"],
        [(f.id, f.subject, size(f.size_bytes), f.path) for f in found.files],
        empty="it has made no file",
    )


@app.command()
def logs(job: JobId, home: Home = None) -> None:
    """Print the log of a job, whichever host has run it.

    Example: sms job logs 3f2a
    """
    with bootstrap.services(home) as services:
        found = jobs_.log(services, job)
    if found.text is not None:
        output.print_text(found.text)
    else:
        short = found.job.id[:SHORT_ID]
        output.say(f"job {short} is {found.job.state} and has written no log: there is no {found.path}")


@app.command()
def watch(
    jobs: JobIds = None,
    campaign: CampaignOption = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Follow jobs, all active ones if none is named, until they have ended: how fast, and how long it takes.

    With --json, one object a change, and at last one of how they ended, as of 'sms job wait'.

    Example: sms job watch -c wing-fatigue
    """
    from sms_jobs.app.work.waiting import wait_for

    with bootstrap.services(home) as services:
        some = jobs_.choose(services, jobs or [], campaign)
        counted_before: dict[str, int] = {}
        with followed(stop="sms job cancel") as show_on_bar:

            def tell(now: Waiting) -> None:
                nonlocal counted_before
                show_on_bar(now)
                if as_json and now.counted != counted_before:
                    ahead = {} if now.outlook is None else outlook_as_json(now.outlook)
                    output.print_json({"jobs": now.counted} | ahead)
                counted_before = now.counted

            waited = wait_for(services, some, tell=tell)
    _tell_ended(waited, as_json, output.print_sentence)


@app.command()
def wait(
    jobs: JobIds = None,
    campaign: CampaignOption = None,
    timeout: Annotated[float | None, typer.Option(help="Seconds to wait at most.", min=0.0)] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Return when jobs, all active ones if none is named, have ended.

    Exit codes: 0 all succeeded, 5 one did not, 124 time ran out.

    Example: sms job wait -c wing-fatigue --timeout 3600
    """
    from sms_jobs.app.work.waiting import wait_for

    with bootstrap.services(home) as services:
        some = jobs_.choose(services, jobs or [], campaign)
        with followed(stop="sms job cancel") as tell:
            waited = wait_for(services, some, timeout, tell)
    _tell_waited(waited, as_json)


@app.command()
def cancel(
    jobs: JobIds = None,
    campaign: CampaignOption = None,
    home: Home = None,
) -> None:
    """Cancel jobs; running ones stop at their next checkpoint, or are ended when they reach none.

    Example: sms job cancel 3f2a
    """
    with bootstrap.services(home) as services:
        cancelled = jobs_.cancel(services, jobs or [], campaign)
    output.say(f"cancelled {number_of(cancelled, 'job')}")


@app.command()
def retry(
    jobs: JobIds = None,
    campaign: CampaignOption = None,
    home: Home = None,
) -> None:
    """Give jobs that ended without success another chance, with all that was skipped for them.

    Example: sms job retry -c wing-fatigue
    """
    with bootstrap.services(home) as services:
        count = jobs_.retry(services, jobs or [], campaign)
    output.say(f"to run again: {number_of(count, 'job')}")


@app.command()
def explain(job: JobId, home: Home = None, as_json: Json = False) -> None:
    """Say why a job waits, ran, was reused, or is stale.

    Example: sms job explain 3f2a
    """
    with bootstrap.services(home) as services:
        found = jobs_.explain(services, job)
    if as_json:
        output.print_json({"job": found.job_id, "explanation": found.sentences})
        return
    for sentence in found.sentences:
        output.print_sentence(sentence)


def _tell_waited(waited: Waited, as_json: bool) -> None:
    """Print how jobs ended; raise `JobFailed` where one did not succeed."""
    _tell_ended(waited, as_json, output.say)
    waited.require_success()


def _tell_ended(waited: Waited, as_json: bool, tell: Callable[[str], None]) -> None:
    """Print how jobs ended, with what they remark about their data."""
    empty = waited.empty
    if as_json:
        nothing = {"nothing_valid": {"jobs": empty.count, "latest": empty.latest}} if empty.count else {}
        output.print_json({"jobs": waited.counted} | nothing | remarks_as_json(waited.remarks))
        return
    counted = dict(waited.counted)
    if empty.count:
        counted[JobState.SUCCEEDED.value] -= empty.count
        counted["ended with nothing valid"] = empty.count
    tell(", ".join(f"{count} {state}" for state, count in counted.items() if count) or _NONE_ACTIVE)
    if empty.count:
        output.say(empty.latest)
    tell_remarks(waited.remarks)
