"""`sms init`, `up` and `status`: the home and the service in it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.waiting import told_outlook
from sms_jobs.jobs import inquiry
from sms_jobs.jobs.chosen import Chosen
from sms_jobs.jobs.estimates import outlook
from sms_jobs.records.estimates import Outlook
from sms_jobs.records.job import ALIVE_WITHIN


def init(
    home: Home = None,
    environment_file: Annotated[
        Path | None,
        typer.Option(help="File with SMS_... variables, such as passwords; the home is not used without it."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make a home: folder, settings file and an empty catalogue. What is there is kept.

    Example: sms init --home /data/sms
    """
    settings = bootstrap.initialise(home, environment_file)
    if as_json:
        output.print_json({"home": str(settings.home), "archive": str(settings.archive_root)})
    else:
        output.say(f"the home {settings.home} is ready; start the service with 'sms up'")


def up(
    home: Home = None,
    until_idle: Annotated[
        bool, typer.Option("--until-idle", help="End when no job is left that can run.")
    ] = False,
) -> None:
    """Serve: run queued jobs until Ctrl-C, which lets running jobs finish; twice kills them.

    Example: sms up --home /data/sms
    """
    from sms_jobs.workers.supervisor import Supervisor

    output.log_to_stderr()
    with bootstrap.services(home) as services:
        supervisor = Supervisor(services)
        output.say(
            f"worker {supervisor.worker_id} serves {services.settings.home} with "
            f"{services.settings.workers} jobs at a time; Ctrl-C ends it"
        )
        supervisor.run(until_idle=until_idle)


def status(home: Home = None, as_json: Json = False) -> None:
    """Show campaigns, jobs by state, workers and disk.

    Example: sms status --json
    """
    with bootstrap.services(home) as services:
        facts = _facts(services)
        facts["outlook"] = _ahead(services)
    if as_json:
        output.print_json(facts)
        return
    jobs = facts.pop("jobs")
    workers = facts.pop("workers")
    facts["jobs"] = ", ".join(f"{count} {state}" for state, count in jobs.items()) or "none"
    facts["workers"] = (
        ", ".join(f"{w['id']} on {w['host']}" for w in workers) or "none; start one with 'sms up'"
    )
    facts["archive_free"] = output.size(facts.pop("archive_free_bytes"))
    ahead = facts.pop("outlook")
    if ahead is not None:
        facts["ahead"] = told_outlook(ahead)
    output.print_facts(facts)


def _ahead(services: Services) -> Outlook | None:
    with services.catalogue.reading() as session:
        active = inquiry.still_active(inquiry.counts(session))
        return outlook(session, Chosen(), services.settings.workers) if active else None


def _facts(services: Services) -> dict[str, Any]:
    with services.catalogue.reading() as session:
        return {
            "home": str(services.settings.home),
            "catalogue": services.catalogue.describe(),
            "archive": services.archive.where,
            "archive_free_bytes": services.archive.room().free_bytes,
            "campaigns": campaigns.number_of_campaigns(session),
            "jobs": inquiry.counts(session),
            "workers": [
                {
                    "id": w.id,
                    "host": w.host,
                    "pid": w.pid,
                    "processes": w.processes,
                    "running": w.running,
                    "beat_at": w.beat_at,
                }
                for w in inquiry.workers(session, datetime.now(UTC) - ALIVE_WITHIN)
            ],
        }
