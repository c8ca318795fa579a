"""The service of a home: what it does, who works for it, and its numbers for monitoring."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy.orm import Session

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import job_counts
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.jobs.asking import standing
from sms_jobs.jobs.asking.standing import WorkerView
from sms_jobs.jobs.devices import disks
from sms_jobs.jobs.recording.any_plans import any_plans
from sms_jobs.records.job import ALIVE_WITHIN
from sms_jobs.records.people import Right
from sms_jobs.records.shown.estimates import Outlook
from sms_jobs.records.shown.planned_recordings import PlannedRecording

if TYPE_CHECKING:
    from sms_jobs.workers.supervisor import Supervisor

_SHOWN_FOR = timedelta(minutes=5)
_MOST_RUNNING = 200


@dataclass(frozen=True)
class Status:
    """How a home stands.

    Attributes
    ----------
    home, catalogue, archive
        Where they are; the catalogue without secrets.
    archive_free_bytes
        Room on the archive's disk.
    spool_free_bytes
        Room on the disk of this host's spool; None where that is the archive's disk.
    campaigns
        How many there are.
    jobs
        How many are in each state.
    workers
        Those that are alive.
    outlook
        How the jobs that have not ended come along; None where there are none.
    ends_at
        When those that run will have ended, by id, as far as it can be told.
    planned
        The recording that comes next of each plan.
    """

    home: Path
    catalogue: str
    archive: str
    archive_free_bytes: int
    spool_free_bytes: int | None
    campaigns: int
    jobs: dict[str, int]
    workers: tuple[WorkerView, ...]
    outlook: Outlook | None
    ends_at: dict[str, datetime]
    planned: tuple[PlannedRecording, ...]


@use_case(Right.READ)
def status(services: Services) -> Status:
    """Return how a home stands."""
    with services.catalogue.reading() as session:
        # Among a million jobs counting is most of the work: it is done once.
        counted = job_counts.by_state(session)
        active = standing.still_active(counted)
        ahead, ends_at = _ahead(session, services.settings.workers) if active else (None, {})
        return Status(
            services.settings.home,
            services.catalogue.describe(),
            services.archive.where,
            services.archive.room().free_bytes,
            disks.spool_free_bytes(services.settings.spool_folder, services.settings.archive_root),
            standing.number_of_campaigns(session),
            counted,
            tuple(standing.workers(session, datetime.now(UTC) - ALIVE_WITHIN)),
            ahead,
            ends_at,
            _next_planned(session) if any_plans(session) else (),
        )


def _ahead(session: Session, workers: int) -> tuple[Outlook, dict[str, datetime]]:
    # To estimate takes more than everything else here, and there are jobs only while somebody works.
    from sms_jobs.jobs.planning.chosen import of_campaign
    from sms_jobs.jobs.planning.estimates import ends, outlook

    return outlook(session, of_campaign(session, None), workers), ends(
        session, datetime.now(UTC), _MOST_RUNNING
    )


def _next_planned(session: Session) -> tuple[PlannedRecording, ...]:
    # Which loads triggers, levels and limits: only a home with plans needs them.
    from sms_jobs.jobs.recording.shown_plans import list_planned

    return tuple(one for one in list_planned(session, datetime.now(UTC)) if one.is_next)


@use_case(Right.ADMINISTER)
def supervisor(services: Services, queues: Sequence[str] | None = None) -> Supervisor:
    """Return a supervisor of jobs on this host, which serves once its `run` is called.

    Parameters
    ----------
    queues
        That it serves, of this host's; None for those of every deployment.

    Raises `InvalidInput` for a queue that this host does not have.
    """
    # Which loads Celery; nothing else here needs it.
    from sms_jobs.workers.celery_app import ALL_QUEUES
    from sms_jobs.workers.supervisor import Supervisor

    served = (*ALL_QUEUES, *services.stations.queues())
    selected = tuple(ALL_QUEUES if queues is None else queues)
    unknown = [queue for queue in selected if queue not in served]
    if unknown:
        raise InvalidInput(f"there is no queue '{unknown[0]}' here; choose among {', '.join(served)}")
    return Supervisor(services, selected)


@use_case(Right.ADMINISTER)
@contextmanager
def served(services: Services, listen: str) -> Iterator[None]:
    """Serve the console in a process of its own meanwhile, which is restarted when it dies."""
    from sms_jobs.workers.web_process import WebProcess

    process = WebProcess(services.settings.home, listen)
    process.start()
    try:
        yield
    finally:
        process.stop()


@use_case(Right.READ)
def workers(services: Services) -> list[WorkerView]:
    """Return the workers that have lately given a sign of life."""
    with services.catalogue.reading() as session:
        return standing.workers(session, datetime.now(UTC) - _SHOWN_FOR)


@use_case(Right.ADMINISTER)
def drain(services: Services, worker: str) -> str:
    """Let the worker whose id begins so finish what it runs and claim nothing more; return its id.

    Raises `NotFound` where there is not one such worker.
    """
    from sms_jobs.jobs.running import recovery

    with services.catalogue.writing() as session:
        recent = standing.workers(session, datetime.now(UTC) - _SHOWN_FOR)
        matching = [w.id for w in recent if worker and w.id.startswith(worker)]
        if len(matching) != 1:
            which = "are several workers" if matching else "is no worker"
            raise NotFound(f"there {which} '{worker}'; 'sms worker list' shows them")
        recovery.drain(session, matching[0])
    return matching[0]


@use_case(Right.READ)
def metrics(services: Services) -> str:
    """Return the numbers of a home as Prometheus reads them; one says whether the catalogue answers."""
    # Of all commands this one alone needs them.
    from prometheus_client import generate_latest

    from sms_jobs.jobs.monitoring.metrics import Numbers

    return generate_latest(Numbers(services.catalogue, services.archive)).decode()
