"""`sms init`, `up`, `status` and `doctor`: the home and the service in it."""

from __future__ import annotations

import platform
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import h5py
import typer

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, schema
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.waiting import Outlook, outlook
from sms_jobs.errors import SmsError
from sms_jobs.jobs import health, inquiry
from sms_jobs.jobs.chosen import Chosen
from sms_jobs.records.job import ALIVE_WITHIN

_FINDINGS = 6
_LITTLE_ROOM_BYTES = 10e9


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
        facts["ahead"] = str(ahead)
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
            "archive": str(services.archive.root),
            "archive_free_bytes": shutil.disk_usage(services.archive.root).free,
            "campaigns": campaigns.number_of_campaigns(session),
            "jobs": inquiry.counts(session),
            "workers": [
                {"id": w.id, "host": w.host, "pid": w.pid, "running": w.running, "beat_at": w.beat_at}
                for w in inquiry.workers(session, datetime.now(UTC) - ALIVE_WITHIN)
            ],
        }


def doctor(home: Home = None, as_json: Json = False) -> None:
    """Check catalogue, archive, messages, workers, clock and disk; say what to do about each finding.

    Example: sms doctor
    """
    checks: list[_Check] = []
    try:
        with bootstrap.services(home) as services:
            checks.append(_Check("home and catalogue", None, str(services.settings.home)))
            checks += _checks(services)
    except SmsError as error:
        checks.append(_Check("home and catalogue", str(error)))
    bad = any(c.finding for c in checks)
    if as_json:
        shown = [{"check": c.check, "finding": c.finding or "ok", "found": c.found} for c in checks]
        output.print_json({"healthy": not bad, "checks": shown})
    else:
        rows = [(c.check, c.finding or f"ok{c.found and ': '}{c.found}") for c in checks]
        output.print_table(["check", "finding"], rows, empty="")
    if bad:
        raise typer.Exit(_FINDINGS)


@dataclass(frozen=True)
class _Check:
    check: str
    finding: str | None
    found: str = ""


def _checks(services: Services) -> Iterator[_Check]:
    from sms_jobs.workers import broker

    settings, catalogue, archive = services.settings, services.catalogue, services.archive
    drift = schema.differences_from_models(catalogue)
    with catalogue.reading() as session:
        database = health.database_version(session)
        pauses = health.pauses(session)
        workers = health.workers(session, datetime.now(UTC))
        alive = len(inquiry.workers(session, datetime.now(UTC) - ALIVE_WITHIN))
    yield _Check("versions", None, _versions(database))
    yield _Check("schema", f"{len(drift)} differences from this version's: {drift[0]}" if drift else None)
    yield _Check("place of the catalogue", health.database_on_network(catalogue), catalogue.describe())
    yield _Check("clock", health.clock(catalogue, timedelta(seconds=settings.lease_s)))
    what, finding = broker.examine(settings)
    yield _Check("messages", finding, what)
    yield _Check(
        "archive", health.archive_writes(archive) or health.other_file_systems(archive), str(archive.root)
    )
    free = f"{output.size(shutil.disk_usage(archive.root).free)} free"
    yield _Check("disk", health.room(archive.root, _LITTLE_ROOM_BYTES), free)
    yield _Check("queues", pauses)
    yield _Check("workers", workers, f"{alive} alive")


def _versions(database: str) -> str:
    return (
        f"sms {sms_jobs.__version__}, Python {platform.python_version()}, HDF5 {h5py.version.hdf5_version}, "
        f"{database}"
    )
