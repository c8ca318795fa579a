"""Which notification is sent next and what became of it: sent once, tried again, or given up.

A sender claims a notification for some minutes and then says what became of it. One that dies in between
has its claim run out, and another sends: at least once each, under an id by which the receiver knows it
again.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import cast

from sqlalchemy import Table, delete, func, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.notifications import NotificationRow, SubscriptionRow
from sms_jobs.errors import Conflict, NotFound
from sms_jobs.records.shown.notifications import (
    TEST,
    Address,
    Notification,
    SentView,
    SubscriptionView,
    Topic,
)
from sms_jobs.records.subject import checked_name

_CLAIMED_FOR = timedelta(minutes=5)
"""Longer than sending takes at worst."""
_FIRST_PAUSE = timedelta(minutes=1)
_LONGEST_PAUSE = timedelta(hours=1)
GIVEN_UP_AFTER = timedelta(hours=24)
_KEPT_FOR = timedelta(days=30)
_NOTIFICATION = cast(Table, NotificationRow.__table__)


@dataclass(frozen=True)
class Delivery:
    """A notification that somebody has claimed, to be sent now.

    Attributes
    ----------
    row_id, tries
        By which the claim is known.
    secret
        That signs what a webhook is sent.
    """

    row_id: int
    tries: int
    subscription: str
    address: Address
    secret: str
    notification: Notification


def subscribe(
    session: Session, name: str, address: Address, secret: str, topics: list[Topic], now: datetime
) -> None:
    """Add a subscription; raise `Conflict` where there is one of that name."""
    checked_name(name, "subscription")
    row = SubscriptionRow(
        name=name,
        channel=address.channel,
        address=address.whole.get_secret_value(),
        secret=secret,
        topics=[topic.value for topic in topics],
        created_at=now,
    )
    try:
        with session.begin_nested():
            session.add(row)
    except IntegrityError as error:
        raise Conflict(
            f"there is a subscription '{name}' already; remove it, or choose another name"
        ) from error


def unsubscribe(session: Session, name: str) -> None:
    """Remove a subscription, with what it was sent and still has to be."""
    row = _named(session, name)
    session.execute(delete(NotificationRow).where(NotificationRow.subscription_id == row.id))
    session.delete(row)


def subscriptions(session: Session) -> list[SubscriptionView]:
    """Return every subscription, in order of name."""
    unsent = (
        select(NotificationRow.subscription_id, NotificationRow.next_try_at.is_not(None), func.count())
        .where(NotificationRow.sent_at.is_(None))
        .group_by(NotificationRow.subscription_id, NotificationRow.next_try_at.is_not(None))
    )
    counted = {(owner, bool(waits)): count for owner, waits, count in session.execute(unsent)}
    return [
        SubscriptionView(
            row.name,
            row.channel,
            Address.stored(row.channel, row.address).shown,
            tuple(row.topics),
            row.created_at,
            counted.get((row.id, True), 0),
            counted.get((row.id, False), 0),
        )
        for row in session.scalars(select(SubscriptionRow).order_by(SubscriptionRow.name))
    ]


def sent(session: Session, name: str | None, limit: int) -> list[SentView]:
    """Return what was sent, waits or was given up, the newest first; to one subscriber, or to all."""
    query = select(NotificationRow, SubscriptionRow.name).join(SubscriptionRow)
    if name is not None:
        query = query.where(NotificationRow.subscription_id == _named(session, name).id)
    return [
        SentView(
            subscription,
            row.topic,
            row.subject,
            row.created_at,
            "sent" if row.sent_at else "waits" if row.next_try_at else "given up",
            row.tries,
            row.next_try_at,
            row.sent_at,
            row.error,
        )
        for row, subscription in session.execute(query.order_by(NotificationRow.id.desc()).limit(limit))
    ]


def claim_test(session: Session, name: str, now: datetime) -> Delivery | None:
    """Enter and claim a message that somebody wants to see arrive."""
    row = NotificationRow(
        subscription_id=_named(session, name).id,
        topic=TEST,
        campaign="",
        key=f"{TEST}/{uuid.uuid4()}",
        subject=f"a test of the subscription {name}",
        text="Somebody has asked whether this arrives.",
        created_at=now,
        next_try_at=now,
    )
    session.add(row)
    session.flush()
    return claim(session, row.id, row.tries, now)


def next_due(session: Session, now: datetime) -> tuple[int, int] | None:
    """Return number and tries of what is to be sent next; None where nothing is.

    What was never tried comes first: a receiver that does not answer keeps nobody else waiting.
    """
    due = (
        select(NotificationRow.id, NotificationRow.tries)
        .where(NotificationRow.sent_at.is_(None), NotificationRow.next_try_at <= now)
        .order_by(NotificationRow.tries, NotificationRow.next_try_at, NotificationRow.id)
        .limit(1)
    )
    found = session.execute(due).one_or_none()
    return None if found is None else (found.id, found.tries)


def claim(session: Session, row_id: int, tries: int, now: datetime) -> Delivery | None:
    """Claim a notification that has been tried so often; None where somebody else was faster."""
    claimed = session.scalar(
        update(_NOTIFICATION)
        .where(
            _NOTIFICATION.c.id == row_id, _NOTIFICATION.c.tries == tries, _NOTIFICATION.c.sent_at.is_(None)
        )
        .values(tries=tries + 1, next_try_at=now + _CLAIMED_FOR)
        .returning(_NOTIFICATION.c.id)
    )
    if claimed is None:
        return None
    row = session.get_one(NotificationRow, row_id, populate_existing=True)
    subscriber = session.get_one(SubscriptionRow, row.subscription_id)
    return Delivery(
        row.id,
        row.tries,
        subscriber.name,
        Address.stored(subscriber.channel, subscriber.address),
        subscriber.secret,
        Notification(
            # The key alone may be the same in another catalogue.
            uuid.uuid5(uuid.NAMESPACE_OID, f"{row.id}/{row.key}/{row.created_at.isoformat()}").hex,
            row.topic,
            row.subject,
            row.text,
            row.campaign,
            row.created_at,
        ),
    )


def settle(session: Session, delivery: Delivery, error: str | None, now: datetime) -> None:
    """Say what became of a claimed notification: it arrived, or why not; nothing for a claim that ran out."""
    values: Mapping[str, object] = {"sent_at": now, "next_try_at": None, "error": None}
    if error is not None:
        values = {"next_try_at": _next_try(delivery, now), "error": error}
    session.execute(
        update(_NOTIFICATION)
        .where(_NOTIFICATION.c.id == delivery.row_id, _NOTIFICATION.c.tries == delivery.tries)
        .values(**values)
    )


def _next_try(delivery: Delivery, now: datetime) -> datetime | None:
    """Return when it is tried again, after growing pauses; None where it is given up."""
    pause = min(_FIRST_PAUSE * 2 ** min(delivery.tries - 1, 10), _LONGEST_PAUSE)
    late = now + pause > delivery.notification.created_at + GIVEN_UP_AFTER
    return None if late or delivery.notification.topic == TEST else now + pause


def forget(catalogue: Catalogue, now: datetime) -> None:
    """Remove what was sent or given up long ago."""
    with catalogue.writing() as session:
        session.execute(
            delete(NotificationRow).where(
                NotificationRow.next_try_at.is_(None), NotificationRow.created_at < now - _KEPT_FOR
            )
        )


def _named(session: Session, name: str) -> SubscriptionRow:
    row = session.scalar(select(SubscriptionRow).where(SubscriptionRow.name == name))
    if row is None:
        raise NotFound(f"there is no subscription '{name}'; 'sms notify list' shows them")
    return row
