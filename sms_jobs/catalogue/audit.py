"""The chain that says who did what: each link holds the digest of the one before it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import select, text, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.models import EventRow
from sms_jobs.catalogue.people_tables import AuditRow
from sms_jobs.records.people import Actor, Deed, Role

SEALING = "events.seal"
"""The action of a link that holds the digest of events of jobs."""

_ONE_AT_A_TIME = 0x736D735F61756469
"""Number of the lock under which links are added on PostgreSQL; SQLite has one writer anyway."""
_START = "0" * 64
_AT_ONCE = 5_000
_SERVICE = Actor("service", Role.ADMINISTRATOR, "service", "")


def append(session: Session, deed: Deed, now: datetime) -> AuditRow:
    """Add a link at the end of the chain, in the transaction of what it tells.

    It is the last that a transaction does before it commits: others who add one wait for it.
    """
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:number)"), {"number": _ONE_AT_A_TIME})
    last = session.execute(
        select(AuditRow.id, AuditRow.digest).order_by(AuditRow.id.desc()).limit(1)
    ).one_or_none()
    row = AuditRow(
        id=1 if last is None else last.id + 1,
        at=now.astimezone(UTC),
        who=deed.actor.name,
        role="" if deed.actor.role is None else deed.actor.role.value,
        via=deed.actor.via,
        origin=deed.actor.origin,
        action=deed.action,
        arguments=deed.arguments,
        reason=deed.actor.reason,
    )
    row.digest = digest_of(row, _START if last is None else last.digest)
    session.add(row)
    session.flush()
    return row


def digest_of(row: AuditRow, before: str) -> str:
    """Return the digest that a link has behind another."""
    who = [row.who, row.role, row.via, row.origin]
    return _digest([before, row.id, _time(row.at), who, row.action, row.arguments, row.reason])


def seal_events(session: Session, now: datetime) -> int:
    """Put the digest of events that no link holds yet into the chain; return how many, at most 5,000."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:number)"), {"number": _ONE_AT_A_TIME})
    rows = session.scalars(
        select(EventRow).where(EventRow.seal_id.is_(None)).order_by(EventRow.id).limit(_AT_ONCE)
    ).all()
    if not rows:
        return 0
    arguments: dict[str, Any] = {"count": len(rows), "digest": digest_of_events(rows)}
    link = append(session, Deed(_SERVICE, SEALING, arguments), now)
    ids = [row.id for row in rows]
    session.execute(
        update(EventRow)
        .where(EventRow.seal_id.is_(None), EventRow.id >= ids[0], EventRow.id <= ids[-1])
        .values(seal_id=link.id)
        .execution_options(synchronize_session=False)
    )
    return len(rows)


def digest_of_events(rows: Iterable[EventRow]) -> str:
    """Return the digest of events, in the order of their numbers."""
    return _digest([[r.id, r.job_id, _time(r.at), r.state.value, r.attempt, r.message] for r in rows])


def breaks(session: Session) -> Iterator[str]:
    """Say where the chain, or what it holds, is not what was written: a sentence for each place."""
    before, expected = _START, 1
    for row in session.scalars(select(AuditRow).order_by(AuditRow.id).execution_options(yield_per=_AT_ONCE)):
        if row.id != expected:
            yield f"audit {expected} to {row.id - 1} are missing"
        if row.digest != digest_of(row, before):
            yield f"audit {row.id} ({row.action} by {row.who}) is not as it was written, or the one before it"
        elif row.action == SEALING:
            sealed = session.scalars(
                select(EventRow).where(EventRow.seal_id == row.id).order_by(EventRow.id)
            ).all()
            if digest_of_events(sealed) != row.arguments["digest"]:
                yield (
                    f"events of jobs that audit {row.id} holds were changed, put in or taken away: "
                    f"{row.arguments['count']} were sealed, {len(sealed)} are there"
                )
        before, expected = row.digest, row.id + 1


def _time(at: datetime) -> str:
    return at.astimezone(UTC).isoformat(timespec="microseconds")


def _digest(value: Any) -> str:
    text_ = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text_.encode()).hexdigest()
