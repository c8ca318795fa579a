"""`sms init`, `up`, `status` and `doctor`: the home and the service in it."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import schema
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import SmsError
from sms_jobs.jobs import inquiry

_ALIVE_WITHIN = timedelta(seconds=60)
_FINDINGS = 6
_LITTLE_ROOM_BYTES = 10e9


def init(home: Home = None, as_json: Json = False) -> None:
    """Make a home: folder, settings file and an empty catalogue. What is there is kept.

    Example: sms init --home /data/sms
    """
    settings = bootstrap.initialise(home)
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
    output.print_facts(facts)


def _facts(services: Services) -> dict[str, Any]:
    with services.catalogue.reading() as session:
        return {
            "home": str(services.settings.home),
            "catalogue": services.catalogue.describe(),
            "archive": str(services.archive.root),
            "archive_free_bytes": shutil.disk_usage(services.archive.root).free,
            "campaigns": len(inquiry.campaign_names(session)),
            "jobs": inquiry.counts(session),
            "workers": [
                {"id": w.id, "host": w.host, "pid": w.pid, "running": w.running, "beat_at": w.beat_at}
                for w in inquiry.workers(session, datetime.now(UTC) - _ALIVE_WITHIN)
            ],
        }


def doctor(home: Home = None, as_json: Json = False) -> None:
    """Check catalogue, archive, messages, workers and disk; say what to do about each finding.

    Example: sms doctor
    """
    findings: list[dict[str, str]] = []

    def check(what: str, finding: str | None) -> None:
        findings.append({"check": what, "finding": finding or "ok"})

    try:
        with bootstrap.services(home) as services:
            _check_services(services, check)
    except SmsError as error:
        check("home and catalogue", str(error))
    bad = [f for f in findings if f["finding"] != "ok"]
    if as_json:
        output.print_json({"healthy": not bad, "checks": findings})
    else:
        output.print_table(["check", "finding"], [list(f.values()) for f in findings], empty="")
    if bad:
        raise typer.Exit(_FINDINGS)


def _check_services(services: Services, check: Any) -> None:
    from sms_jobs.workers.celery_app import broker_answers

    check("home and catalogue", None)
    drift = schema.differences_from_models(services.catalogue)
    check("schema", f"{len(drift)} differences from this version's: {drift[0]}" if drift else None)
    check("messages", broker_answers(services.settings))
    free = shutil.disk_usage(services.archive.root).free
    little = f"only {output.size(free)} free at {services.archive.root}; make room"
    check("disk", little if free < _LITTLE_ROOM_BYTES else None)
    with services.catalogue.reading() as session:
        alive = inquiry.workers(session, datetime.now(UTC) - _ALIVE_WITHIN)
        waiting = inquiry.still_active(inquiry.counts(session))
    idle = f"{waiting} jobs wait and no worker is alive; start one with 'sms up'"
    check("workers", idle if waiting and not alive else None)
