"""A catalogue with any number of jobs that have not ended, and a past of their kinds.

Tuples of four jobs each that need one another, 2 views a state, 500 states a campaign; the first of each is
queued and the others wait. Ids are random, as those of real jobs are.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import insert
from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue import campaigns, job_counts, upkeep, valid_calibrations
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.queues import DependencyRow, OutboxRow
from sms_jobs.jobs.running import recovery
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.calibration import Acceptance
from sms_jobs.records.job import JobState
from sms_jobs.virtual_rig.campaigns import small_plate

KINDS = ("simulate", "reconstruct", "correlate", "strain")
SECONDS = {"simulate": 4.0, "reconstruct": 10.0, "correlate": 20.0, "strain": 2.0}
"""What each kind has taken."""
QUEUES = {"simulate": "acquisition", "reconstruct": "cpu", "correlate": "cpu", "strain": "cpu"}
VIEWS = ("C1P1", "C1P2")
_STATE = len(KINDS) * len(VIEWS)
CAMPAIGN = _STATE * 500
"""Jobs of a campaign; the last has fewer."""
WORKER = "w0000001"
_AT_ONCE = 10_000
_ENDED = 2000


def name_of(campaign: int) -> str:
    """Return the name of a campaign by its place."""
    return f"c{campaign:04d}"


def fill_queue(
    catalogue: Catalogue,
    active: int,
    now: datetime,
    say: Callable[[str], None] = lambda text: None,
    *,
    each: int | None = None,
) -> None:
    """Fill a catalogue with so many jobs that have not ended, `each` of a campaign, and some that have."""
    each = each or CAMPAIGN
    chance = random.Random(1)  # noqa: S311 - the same jobs every time
    begun = now - timedelta(days=1)
    with catalogue.writing() as session:
        recovery.register_worker(session, WORKER, "here", 1, [*{*QUEUES.values()}], 8, now)
        numbers = _campaigns(session, -(-active // each), each, begun)
    for first in range(0, active, _AT_ONCE):
        with catalogue.writing() as session:
            _jobs(session, range(first, min(active, first + _AT_ONCE)), each, numbers, begun, chance)
        say(f"filled {min(active, first + _AT_ONCE)} jobs")
    with catalogue.writing() as session:
        _past(session, min(active, _ENDED), each, numbers, now, chance)
    job_counts.fold(catalogue)
    upkeep.analyse(catalogue)


def _campaigns(session: Session, count: int, each: int, at: datetime) -> list[int]:
    """Add campaigns of one rig, and return their numbers."""
    calibration, record = small_plate(name_of(0))
    states = tuple(replace(record.states[1], label=f"S{n:03d}") for n in range(-(-each // _STATE)))
    record = replace(record, states=(replace(record.states[0], label="S"), *states))
    for place in range(count):
        campaigns.add_campaign(session, replace(record, name=name_of(place)), at)
    file = FileRow(
        source=CALIBRATION,
        path="calibrations/bench.h5",
        content_hash="0" * 64,
        size_bytes=0,
        media_type=DATASET_MEDIA_TYPE,
        created_at=at,
    )
    session.add(file)
    session.flush()
    number = valid_calibrations.add_calibration(session, calibration, file.id)
    valid_calibrations.decide(
        session, number, Acceptance(calibration.rig.name, file.content_hash), at, file.id
    )
    return [campaigns.campaign_id(session, name_of(place)) for place in range(count)]


def _jobs(
    session: Session,
    places: Sequence[int],
    each: int,
    numbers: Sequence[int],
    begun: datetime,
    chance: random.Random,
) -> None:
    """Add jobs, each with the one that it needs, the event of its submission, and the message about it."""
    rows: list[dict[str, Any]] = []
    edges: list[dict[str, Any]] = []
    for place in places:
        at = begun + timedelta(microseconds=place)
        row = _row(place, each, numbers, at, chance)
        if place % len(KINDS):
            needs = rows[-1]
            edges.append(_edge(row, needs["kind"], needs["id"]))
        rows.append(row)
    session.execute(insert(JobRow), rows)
    session.execute(insert(DependencyRow), edges)
    event = {"attempt": 0, "message": "submitted"}
    session.execute(
        insert(EventRow),
        [{"job_id": r["id"], "at": r["submitted_at"], "state": r["state"], **event} for r in rows],
    )
    queued = [r for r in rows if r["state"] is JobState.QUEUED]
    session.execute(insert(OutboxRow), [{"job_id": r["id"], "queue": r["queue"]} for r in queued])


def _row(
    place: int, each: int, numbers: Sequence[int], at: datetime, chance: random.Random
) -> dict[str, Any]:
    campaign, of_campaign = divmod(place, each)
    state, of_state = divmod(of_campaign, _STATE)
    view, of_view = divmod(of_state, len(KINDS))
    kind = KINDS[of_view]
    return {
        "id": f"{chance.getrandbits(64):016x}",
        "kind": kind,
        "kind_version": 1,
        "campaign_id": numbers[campaign],
        "subject": f"{name_of(campaign)}/S{state:03d}/{VIEWS[view]}",
        "parameters": {},
        "queue": QUEUES[kind],
        "position": int(at.timestamp() * 1e6),
        "repeatable": True,
        "state": JobState.WAITING if of_view else JobState.QUEUED,
        "submitted_at": at,
    }


def _edge(row: dict[str, Any], source: str, producer: str) -> dict[str, Any]:
    return {
        "job_id": row["id"],
        "role": source,
        "source": source,
        "subject": row["subject"],
        "producer_id": producer,
    }


def _past(
    session: Session, count: int, each: int, numbers: Sequence[int], now: datetime, chance: random.Random
) -> None:
    """Add jobs that have succeeded, the last of them just now."""
    rows = []
    for place in range(count):
        ended = now - timedelta(seconds=count - place)
        row = _row(place, each, numbers, ended - timedelta(days=2), chance)
        begun = ended - timedelta(seconds=SECONDS[row["kind"]])
        rows.append(
            row
            | {"state": JobState.SUCCEEDED, "worker_id": WORKER, "attempts": 1, "progress": 1.0}
            | {"started_at": begun, "finished_at": ended}
        )
    session.execute(insert(JobRow), rows)
