"""The chain that says who did what: each link holds the digest of the one before it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import func, select, text, update
from sqlalchemy.orm import Session

from sms_jobs.catalogue.deeds import Deed
from sms_jobs.catalogue.tables.audit import AuditRow
from sms_jobs.catalogue.tables.jobs import EventRow
from sms_jobs.errors import CatalogueDamaged
from sms_jobs.records.people import Actor, Role

if TYPE_CHECKING:
    from sms_jobs.records.shown.people import Link

SEALING = "events.seal"
"""The action of a link that holds the digest of events of jobs."""

_ONE_AT_A_TIME = 0x736D735F61756469
"""Number of the lock under which links are added on PostgreSQL; SQLite has one writer anyway."""
_START = "0" * 64
_AT_ONCE = 5_000
_UNREADABLE = (ValueError, LookupError, TypeError, AttributeError)
"""What is raised where a value of a row is none that its column can have; SQLite takes any."""
_SERVICE = Actor("service", Role.ADMINISTRATOR, "service", "")


def append(session: Session, deed: Deed, now: datetime) -> AuditRow:
    """Add a link at the end of the chain, in the transaction of what it tells.

    It is the last that a transaction does before it commits: others who add one wait for it.
    """
    _hold_the_end(session)
    number, before = head(session)
    row = AuditRow(
        id=number + 1,
        at=now.astimezone(UTC),
        who=deed.actor.name,
        role="" if deed.actor.role is None else deed.actor.role.value,
        via=deed.actor.via,
        origin=deed.actor.origin,
        action=deed.action,
        arguments=deed.arguments,
        reason=deed.actor.reason,
    )
    row.digest = digest_of(row, before)
    session.add(row)
    session.flush()
    return row


def digest_of(row: AuditRow, before: str) -> str:
    """Return the digest that a link has behind another."""
    who = [row.who, row.role, row.via, row.origin]
    return _digest([before, row.id, _time(row.at), who, row.action, row.arguments, row.reason])


def seal_events(session: Session, now: datetime) -> int:
    """Put the digest of events that no link holds yet into the chain; return how many, at most 5,000."""
    _hold_the_end(session)
    number = head(session)[0] + 1
    loose = select(EventRow.id).where(EventRow.seal_id.is_(None)).order_by(EventRow.id).limit(_AT_ONCE)
    # Taken first and then read: of events that others commit meanwhile none is taken that was not read.
    session.execute(
        update(EventRow)
        .where(EventRow.id.in_(loose))
        .values(seal_id=number)
        .execution_options(synchronize_session=False)
    )
    rows = _sealed(session, number)
    if rows:
        told: dict[str, Any] = {"count": len(rows), "digest": digest_of_events(rows)}
        append(session, Deed(_SERVICE, SEALING, told), now)
    return len(rows)


def unsealed(session: Session) -> bool:
    """Return whether there are events of jobs that no link holds yet."""
    return session.scalar(select(EventRow.id).where(EventRow.seal_id.is_(None)).limit(1)) is not None


def digest_of_events(rows: Iterable[Any]) -> str:
    """Return the digest of events, in the order of their numbers."""
    return _digest([[r.id, r.job_id, _time(r.at), r.state.value, r.attempt, r.message] for r in rows])


def head(session: Session) -> tuple[int, str]:
    """Return number and digest of the last link; those of an empty chain are 0 and 64 zeros."""
    last = select(AuditRow.id, AuditRow.digest).order_by(AuditRow.id.desc()).limit(1)
    found = session.execute(last).one_or_none()
    return (0, _START) if found is None else (found.id, found.digest)


def listed(
    session: Session,
    *,
    who: str | None,
    action: str | None,
    since: datetime | None,
    limit: int,
    after: int | None = None,
) -> list[Link]:
    """Return links, the newest first: of a person, of a use case or a group of them, from a time on.

    With `after`, they are those behind the link of that number in this order: the older ones.
    Those that seal events, one every few seconds, are left out unless they are asked for by their action.
    """
    query = select(AuditRow).order_by(AuditRow.id.desc()).limit(limit)
    if who is not None:
        query = query.where(AuditRow.who == who)
    if action is not None:
        group = AuditRow.action.startswith(f"{action}.", autoescape=True)
        query = query.where((AuditRow.action == action) | group)
    else:
        query = query.where(AuditRow.action != SEALING)
    if since is not None:
        query = query.where(AuditRow.at >= since)
    if after is not None:
        query = query.where(AuditRow.id < after)
    return [_link_view(row) for row in session.scalars(query)]


def all_links(session: Session) -> Iterator[Link]:
    """Yield every link, in order."""
    for number, row in _links(session):
        if row is None:
            raise CatalogueDamaged(f"audit {number} cannot be read; run 'sms audit verify'")
        yield _link_view(row)


def extent(session: Session) -> tuple[int, int]:
    """Return how many links there are, and how many events of jobs they hold."""
    links = session.scalar(select(func.count()).select_from(AuditRow)) or 0
    sealed = select(func.count()).select_from(EventRow).where(EventRow.seal_id.is_not(None))
    return links, session.scalar(sealed) or 0


def _link_view(row: AuditRow) -> Link:
    from sms_jobs.records.shown.people import Link

    return Link(
        row.id,
        row.at,
        row.who,
        row.role,
        row.via,
        row.origin,
        row.action,
        row.arguments,
        row.reason,
        row.digest,
    )


def breaks(session: Session, kept: tuple[int, str] | None = None) -> Iterator[str]:
    """Say where the chain, or what it holds, is not what was written: a sentence for each place.

    Parameters
    ----------
    kept
        Number and digest of a link, as `head` gave them once; it has to be there still.
    """
    before, expected, seals = _START, 1, set()
    if kept is not None and kept[0] == 0:
        kept = None
    for number, row in _links(session):
        if number != expected:
            yield f"audit {expected} to {number - 1} are missing"
        expected = number + 1
        if row is None:
            yield f"audit {number} cannot be read: it is not as it was written"
            before = ""
            continue
        if row.digest != digest_of(row, before):
            yield f"audit {number} ({row.action} by {row.who}) is not as it was written, or the one before it"
        elif row.action == SEALING:
            seals.add(number)
            yield from _breaks_of_seal(session, row)
        if kept is not None and kept[0] == number and kept[1] != row.digest:
            yield f"audit {number} is not the one that was kept elsewhere: the chain was written anew"
        before = row.digest
    if kept is not None and kept[0] >= expected:
        yield f"audit {expected} to {kept[0]} are missing: {kept[0]} was kept elsewhere as the last"
    held = select(EventRow.seal_id, func.count()).where(EventRow.seal_id.is_not(None))
    for seal, count in session.execute(held.group_by(EventRow.seal_id).order_by(EventRow.seal_id)):
        if seal is not None and seal >= expected:
            yield f"{count} events of jobs were sealed by audit {seal}, and the chain ends at {expected - 1}"
        elif seal not in seals:
            yield f"{count} events of jobs say that audit {seal} holds them, which is no whole seal"


def _breaks_of_seal(session: Session, row: AuditRow) -> Iterator[str]:
    try:
        sealed = _sealed(session, row.id)
    except _UNREADABLE:
        yield f"an event of a job that audit {row.id} holds cannot be read: it is not as it was written"
        return
    if digest_of_events(sealed) != row.arguments["digest"]:
        yield (
            f"events of jobs that audit {row.id} holds were changed, put in or taken away: "
            f"{row.arguments['count']} were sealed, {len(sealed)} are there"
        )


def _links(session: Session) -> Iterator[tuple[int, AuditRow | None]]:
    """Yield every link with its number, in order; None for one in which a value is none of its column."""
    numbers = select(AuditRow.id).order_by(AuditRow.id).limit(_AT_ONCE)
    some = session.scalars(numbers).all()
    while some:
        those = select(AuditRow).where(AuditRow.id.between(some[0], some[-1])).order_by(AuditRow.id)
        try:
            yield from [(row.id, row) for row in session.scalars(those)]
        except _UNREADABLE:
            yield from ((number, _link(session, number)) for number in some)
        session.expunge_all()
        some = session.scalars(numbers.where(AuditRow.id > some[-1])).all()


def _link(session: Session, number: int) -> AuditRow | None:
    try:
        return session.scalars(select(AuditRow).where(AuditRow.id == number)).one()
    except _UNREADABLE:
        return None


def _sealed(session: Session, number: int) -> Sequence[Any]:
    """Return the events that a link holds, in the order of their numbers."""
    columns = (EventRow.id, EventRow.job_id, EventRow.at, EventRow.state, EventRow.attempt, EventRow.message)
    return session.execute(select(*columns).where(EventRow.seal_id == number).order_by(EventRow.id)).all()


def _hold_the_end(session: Session) -> None:
    """Let nobody else add a link before this transaction ends."""
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text("SELECT pg_advisory_xact_lock(:number)"), {"number": _ONE_AT_A_TIME})


def _time(at: datetime) -> str:
    return at.astimezone(UTC).isoformat(timespec="microseconds")


def _digest(value: Any) -> str:
    text_ = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text_.encode()).hexdigest()
