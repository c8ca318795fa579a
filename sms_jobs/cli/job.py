"""`sms job`: submit, follow and mend jobs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search, upkeep
from sms_jobs.cli import completion, output
from sms_jobs.cli.kind_options import CONTEXT, KindCommand, split_words
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.waiting import as_json as outlook_as_json
from sms_jobs.cli.waiting import told, told_outlook, unsuccessful, wait_for
from sms_jobs.errors import Conflict, InvalidInput, JobFailed
from sms_jobs.jobs import chosen, crowds, inquiry, lifecycle
from sms_jobs.jobs.chosen import Chosen
from sms_jobs.jobs.estimates import estimate_planned, outlook
from sms_jobs.jobs.logs import job_log
from sms_jobs.jobs.planning import PIPELINE, Request
from sms_jobs.jobs.submission import Submission, draft, enter, while_outdated
from sms_jobs.jobs.turns import planning_turn
from sms_jobs.kinds import all_kinds
from sms_jobs.records.estimates import Estimate, Outlook
from sms_jobs.records.job import JobState

app = typer.Typer(help="Jobs: submit, follow and mend them.", no_args_is_help=True)

Campaign = Annotated[
    str | None,
    typer.Option("--campaign", "-c", help="Name of the campaign.", autocompletion=completion.campaign_names),
]
JobId = Annotated[
    str, typer.Argument(help="Job id, or the beginning of one.", autocompletion=completion.job_ids)
]

JobIds = Annotated[
    list[str] | None,
    typer.Argument(help="Job ids, or the beginnings of them.", autocompletion=completion.job_ids),
]


@app.command(cls=KindCommand, context_settings=CONTEXT)
def submit(
    kind: Annotated[
        list[str],
        typer.Argument(
            help="Job kinds, or 'pipeline' for all but simulate; see 'sms job kinds'.",
            autocompletion=completion.kind_names,
        ),
    ],
    campaign: Annotated[
        str,
        typer.Option(
            "--campaign", "-c", help="Name of the campaign.", autocompletion=completion.campaign_names
        ),
    ],
    state: Annotated[
        list[str] | None,
        typer.Option(help="Only this state; can be repeated.", autocompletion=completion.state_labels),
    ] = None,
    view: Annotated[
        list[str] | None,
        typer.Option(help="Only this view; can be repeated.", autocompletion=completion.view_names),
    ] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="NAME=VALUE of the kind, or KIND.NAME=VALUE of the pipeline; can be repeated."
        ),
    ] = None,
    priority: Annotated[int, typer.Option(help="Higher runs earlier.", min=-100, max=100)] = 0,
    no_cache: Annotated[
        bool, typer.Option("--no-cache", help="Compute again what was computed before.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Return when the jobs have ended.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be submitted and how long it would take.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Submit jobs for the tuples of a campaign, and say when they will have ended.

    The estimate comes from how long such jobs have taken before. Of a single kind, a parameter can be given
    like an option: `--help` after the kind shows them.

    Example: sms job submit pipeline -c wing-fatigue --dry-run

    Example: sms job submit pipeline -c wing-fatigue --set strain.gauge_length_mm=30

    Example: sms job submit reconstruct --method fdr --returns 2 -c wing-fatigue
    """
    if wait and dry_run:
        raise InvalidInput("--dry-run submits nothing that --wait could wait for; give one of them")
    kind, settings = split_words(kind)
    parameters = given_parameters([*settings, *(parameter or [])])
    requests = requested(kind, parameters, tuple(state or ()), tuple(view or ()))
    with bootstrap.services(home) as services:
        done, ahead = _planned(services, campaign, requests, priority, not no_cache, dry_run)
        counted = {name: done.kinds.count(name) for name in dict.fromkeys(done.kinds)}
        if as_json and dry_run:
            output.print_json({"campaign": campaign, "jobs": counted, "estimate": ahead})
        elif as_json and not wait:
            output.print_json({"campaign": campaign, "jobs": done.job_ids, "estimate": ahead})
        elif not as_json:
            what = ", ".join(f"{count} {name}" for name, count in counted.items())
            would = "would submit" if dry_run else "submitted"
            output.say(f"{would} {len(done.job_ids)} jobs: {what}" if counted else "there is nothing to do")
            if counted:
                output.say(told(ahead))
        if wait:
            _wait(services, chosen.submitted(done), None, as_json)


def _planned(
    services: Services,
    campaign: str,
    requests: Sequence[Request],
    priority: int,
    use_cache: bool,
    dry_run: bool,
) -> tuple[Submission, Estimate]:
    """Plan jobs and tell how long they take; enter them, unless that is all that is asked for."""
    now = datetime.now(UTC)

    def attempt() -> tuple[Submission, Estimate]:
        with services.catalogue.reading() as session:
            planned = draft(session, campaign, requests, now, priority=priority, use_cache=use_cache)
            ahead = estimate_planned(session, planned, now, services.settings.workers)
        if dry_run:
            return planned.submission, ahead
        with services.catalogue.writing() as session:
            return enter(session, planned), ahead

    with planning_turn(services.settings.home):
        done, ahead = while_outdated(attempt)
    if not dry_run and len(done.job_ids) >= upkeep.MANY:
        upkeep.analyse(services.catalogue)
    return done, ahead


@app.command()
def kinds(as_json: Json = False) -> None:
    """Show the job kinds and their parameters with defaults; as JSON, what they take and give as well.

    Example: sms job kinds
    """
    found = [
        {
            "kind": kind.name,
            "version": kind.version,
            "per": kind.scope.value,
            "summary": kind.summary,
            "inputs": [port.described() for port in kind.inputs],
            "outputs": [product.described() for product in kind.outputs],
            "parameters": {
                name: None if field.is_required() else field.get_default(call_default_factory=True)
                for name, field in kind.parameters.model_fields.items()
            },
        }
        for kind in all_kinds().values()
    ]
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["kind", "per", "summary", "parameters"],
        [
            (k["kind"], k["per"], k["summary"], ", ".join(f"{n}={v}" for n, v in _items(k["parameters"])))
            for k in found
        ],
        empty="there is no job kind: the installation is broken",
    )


@app.command("list")
def list_(
    campaign: Campaign = None,
    state: Annotated[list[JobState] | None, typer.Option(help="Only in this state; can be repeated.")] = None,
    kind: Annotated[str | None, typer.Option(help="Only of this kind.")] = None,
    limit: Annotated[int, typer.Option(help="At most so many, the latest.", min=1, max=100_000)] = 50,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show jobs, the latest first.

    Example: sms job list -c wing-fatigue --state failed
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        jobs = inquiry.list_jobs(session, campaign=campaign, states=state or (), kind=kind, limit=limit)
        active, ahead = 0, None
        if campaign is not None and not as_json:
            scope = chosen.of_campaign(session, campaign)
            active = inquiry.still_active(inquiry.counts(session, scope))
            ahead = outlook(session, scope, services.settings.workers) if active else None
    if as_json:
        output.print_json_list(jobs)
        return
    output.print_table(
        ["job", "kind", "subject", "state", "%", "seconds", "message"],
        [
            (
                j.id[: inquiry.SHORT],
                j.kind,
                j.subject,
                j.state,
                f"{100 * j.progress:.0f}",
                j.seconds,
                j.message,
            )
            for j in jobs
        ],
        empty="there is no such job",
    )
    if ahead is not None:
        output.say(f"{active} jobs of {campaign} have not ended: {told_outlook(ahead)}")


@app.command()
def show(job: JobId, home: Home = None, as_json: Json = False) -> None:
    """Show a job, what has happened to it, and the files that it made.

    Example: sms job show 3f2a
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        row = inquiry.find_job(session, job)
        view = inquiry.job_view(row)
        happened = inquiry.events(session, row.id)
        files = search.files_of_job(session, row.reused_from or row.id)
    if as_json:
        output.print_json({"job": view, "events": happened, "files": files})
        return
    output.print_facts(
        {
            "job": view.id,
            "kind": view.kind,
            "subject": view.subject,
            "state": view.state,
            "message": view.message,
            "parameters": ", ".join(f"{n}={v}" for n, v in view.parameters.items()),
            "attempts": view.attempts,
            "seconds": view.seconds,
        }
    )
    output.print_table(
        ["time", "state", "attempt", "message"],
        [(e.at, e.state, e.attempt, e.message) for e in happened],
        empty="",
    )
    output.print_table(
        ["file", "subject", "size", "path"],
        [(f.id, f.subject, output.size(f.size_bytes), f.path) for f in files],
        empty="it has made no file",
    )


@app.command()
def logs(job: JobId, home: Home = None) -> None:
    """Print the log of a job, whichever host has run it.

    Example: sms job logs 3f2a
    """
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            row = inquiry.find_job(session, job)
        path = job_log(services.settings.job_log_folder, row.id)
    if path.exists():
        output.print_text(path.read_text(encoding="utf-8", errors="backslashreplace"))
    else:
        output.say(
            f"job {row.id[: inquiry.SHORT]} is {row.state.value} and has written no log: there is no {path}"
        )


@app.command()
def watch(
    jobs: JobIds = None,
    campaign: Campaign = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Follow jobs, all active ones if none is named, until they have ended: how fast, and how long it takes.

    With --json, one object a change.

    Example: sms job watch -c wing-fatigue
    """
    with bootstrap.services(home) as services:
        followed = named_jobs(services, jobs or [], campaign)

        def tell(counted: dict[str, int], ahead: Outlook | None) -> None:
            if as_json:
                output.print_json({"jobs": counted} | ({} if ahead is None else outlook_as_json(ahead)))

        counted = wait_for(services.catalogue, followed, None, tell, workers=services.settings.workers)
    if not as_json:
        output.print_sentence(", ".join(f"{n} {s}" for s, n in counted.items()) or "no job is active")


@app.command()
def wait(
    jobs: JobIds = None,
    campaign: Campaign = None,
    timeout: Annotated[float | None, typer.Option(help="Seconds to wait at most.", min=0.0)] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Return when jobs, all active ones if none is named, have ended.

    Exit codes: 0 all succeeded, 5 one did not, 124 time ran out.

    Example: sms job wait -c wing-fatigue --timeout 3600
    """
    with bootstrap.services(home) as services:
        _wait(services, named_jobs(services, jobs or [], campaign), timeout, as_json)


@app.command()
def cancel(
    jobs: JobIds = None,
    campaign: Campaign = None,
    home: Home = None,
) -> None:
    """Cancel jobs; running ones stop at their next checkpoint, or are ended when they reach none.

    Example: sms job cancel 3f2a
    """
    if not jobs and campaign is None:
        raise InvalidInput("name the jobs to cancel, or a campaign with --campaign")
    with bootstrap.services(home) as services:
        some = named_jobs(services, jobs or [], campaign)
        cancelled = crowds.cancel(services.catalogue, some, datetime.now(UTC))
    if jobs and not cancelled:
        raise Conflict("these jobs have ended already; nothing was cancelled")
    output.say(f"cancelled {cancelled} jobs")


@app.command()
def retry(
    jobs: JobIds = None,
    campaign: Campaign = None,
    home: Home = None,
) -> None:
    """Give jobs that ended without success another chance, with all that was skipped for them.

    Example: sms job retry -c wing-fatigue
    """
    if not jobs and campaign is None:
        raise InvalidInput("name the jobs to retry, or a campaign with --campaign")
    with bootstrap.services(home) as services:
        now = datetime.now(UTC)
        if campaign is not None and not jobs:
            count = crowds.retry(services.catalogue, campaign, now)
        else:
            with services.catalogue.writing() as session:
                ids = inquiry.find_jobs(session, jobs or [])
                count = sum(lifecycle.retry(session, job_id, now) for job_id in ids)
    output.say(f"{count} jobs run again")


@app.command()
def explain(job: JobId, home: Home = None, as_json: Json = False) -> None:
    """Say why a job waits, ran, was reused, or is stale.

    Example: sms job explain 3f2a
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        row = inquiry.find_job(session, job)
        sentences = inquiry.explain(session, row, datetime.now(UTC))
    if as_json:
        output.print_json({"job": row.id, "explanation": sentences})
        return
    for sentence in sentences:
        output.print_sentence(sentence)


def _items(mapping: Any) -> list[tuple[str, Any]]:
    return list(mapping.items())


def requested(
    kinds: Sequence[str], parameters: dict[str, Any], states: tuple[str, ...], views: tuple[str, ...]
) -> list[Request]:
    """Give each kind its parameters: all to a single one, by `KIND.` to one of several."""
    if len(kinds) == 1:
        return [Request(kinds[0], parameters, states, views)]
    stray = [name for name in parameters if name.partition(".")[0] not in kinds]
    if stray and PIPELINE not in kinds:
        raise InvalidInput(
            f"parameter '{stray[0]}' must be KIND.NAME=VALUE, with KIND one of {', '.join(kinds)}"
        )
    requests = []
    for kind in kinds:
        own = {name: value for name, value in parameters.items() if name.startswith(f"{kind}.")}
        given = {name.partition(".")[2]: value for name, value in own.items()}
        if kind == PIPELINE:
            given = {n: v for n, v in parameters.items() if n.partition(".")[0] not in kinds}
        requests.append(Request(kind, given, states, views))
    return requests


def given_parameters(settings: Sequence[str]) -> dict[str, Any]:
    """Return the parameters of NAME=VALUE words; a value with commas is a list."""
    parameters = {}
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals or not name:
            raise InvalidInput(f"'{text}' is not NAME=VALUE")
        parameters[name] = value.split(",") if "," in value else value
    return parameters


def named_jobs(services: Services, prefixes: Sequence[str], campaign: str | None) -> Chosen:
    """Choose the named jobs; if none is named, all active ones, or a campaign's."""
    with services.catalogue.reading() as session:
        if prefixes:
            return chosen.named(inquiry.find_jobs(session, prefixes))
        return chosen.active_now(session, campaign)


def _wait(services: Services, waited_for: Chosen, timeout: float | None, as_json: bool) -> None:
    counted = wait_for(services.catalogue, waited_for, timeout, workers=services.settings.workers)
    if as_json:
        output.print_json({"jobs": counted})
    else:
        output.say(
            ", ".join(f"{count} {state}" for state, count in counted.items()) or "there is no such job"
        )
    failures = unsuccessful(counted)
    if failures:
        with services.catalogue.reading() as session:
            last = inquiry.failure(session, waited_for)
        raise JobFailed(f"{failures} of {sum(counted.values())} jobs did not succeed; {last}")
