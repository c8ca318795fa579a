"""Makes notifications of what has happened: few messages of many occurrences, one for each subscriber.

Several supervisors may do it at once. Whoever takes occurrences away tells them, in the same transaction;
what follows from how things stand has a key that can be entered once.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any, cast

from sqlalchemy import CursorResult, delete, exists, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import EventRow, JobRow
from sms_jobs.catalogue.tables.notifications import NotificationRow, OccurrenceRow, SubscriptionRow
from sms_jobs.records.job import ACTIVE, JobState
from sms_jobs.records.shown.notifications import TOPICS, Topic
from sms_jobs.records.texts import harmless

GATHERED_FOR = timedelta(minutes=1)
"""What happens to a campaign within that of the first is told in one message."""
_RECENT = timedelta(hours=1)
"""A queue that was done longer ago is not told any more."""
_MOST_LINES = 20
_LONGEST_LINE = 300
_MOST_EVENTS = 100_000
_ENDED = frozenset(JobState) - ACTIVE


def gather(catalogue: Catalogue, now: datetime) -> None:
    """Tell what has happened, once it is a minute since the first of each topic and campaign."""
    with catalogue.reading() as session:
        due = session.execute(
            select(OccurrenceRow.topic, OccurrenceRow.campaign)
            .group_by(OccurrenceRow.topic, OccurrenceRow.campaign)
            .having(func.min(OccurrenceRow.at) <= now - GATHERED_FOR)
        ).all()
    for topic, campaign in due:
        with catalogue.writing() as session:
            _tell_gathered(session, Topic(topic), campaign, now)


def _tell_gathered(session: Session, topic: Topic, campaign: str, now: datetime) -> None:
    of_these = (OccurrenceRow.topic == topic.value, OccurrenceRow.campaign == campaign)
    first = session.scalars(
        select(OccurrenceRow)
        .where(*of_these)
        .order_by(OccurrenceRow.at, OccurrenceRow.id)
        .limit(_MOST_LINES)
        .with_for_update()
    ).all()
    if not first or first[0].at > now - GATHERED_FOR:
        return  # another supervisor was faster
    lines = [_line(f"- {row.about}: {row.message}") for row in first]
    named = f"{topic.value}\n{campaign}\n{first[0].at.isoformat()}\n{first[0].about}"
    # As many as are taken away are told, also those that were entered since the first were read.
    taken = session.execute(
        delete(OccurrenceRow).where(*of_these).execution_options(synchronize_session=False)
    )
    count = cast(CursorResult[Any], taken).rowcount
    told = TOPICS[topic]
    subject = (told.singular if count == 1 else told.plural).format(campaign=campaign, count=f"{count:,}")
    if count > len(lines):
        lines.append(f"- and {count - len(lines):,} more")
    text = "\n".join([*lines, "", told.advice.format(campaign=campaign)])
    key = hashlib.sha256(named.encode()).hexdigest()
    _tell(session, topic, key, _line(subject), text, now, campaign=campaign)


def tell_queue_done(catalogue: Catalogue, now: datetime) -> None:
    """Tell that nothing is left that could run, a minute after the last job that did."""
    with catalogue.reading() as session:
        active = session.scalar(select(exists().where(JobRow.state.in_(ACTIVE))))
        last = session.execute(
            select(EventRow.id, EventRow.at).order_by(EventRow.id.desc()).limit(1)
        ).one_or_none()
        if active or last is None or not GATHERED_FOR <= now - last.at <= _RECENT:
            return
        if not _subscribers(session, Topic.QUEUE_DONE, last.at):
            return
        before = session.scalar(
            select(NotificationRow.key)
            .where(NotificationRow.topic == Topic.QUEUE_DONE.value)
            .order_by(NotificationRow.id.desc())
            .limit(1)
        )
        since = last.id - _MOST_EVENTS if before is None else int(before.rpartition("/")[2])
        if since == last.id:
            return
        changes = select(EventRow.state, func.count()).where(EventRow.id > since, EventRow.id <= last.id)
        counted = Counter[JobState](dict(session.execute(changes.group_by(EventRow.state)).all()))
    if not counted[JobState.RUNNING]:
        return  # somebody has cancelled what had stopped anyway
    ended = [f"{counted[state]:,} {state.value}" for state in JobState if state in _ENDED and counted[state]]
    told = TOPICS[Topic.QUEUE_DONE]
    text = "\n".join([f"Jobs that have ended: {', '.join(ended)}.", "", told.advice])
    with catalogue.writing() as session:
        _tell(session, Topic.QUEUE_DONE, f"queue-done/{last.id}", told.singular, text, now, since=last.at)


def tell_disk_low(catalogue: Catalogue, free_mb: float, now: datetime) -> None:
    """Tell, once a day, that the archive's disk has so little room left, in MB."""
    key = f"disk-low/{now:%Y-%m-%d}"
    with catalogue.reading() as session:
        told_today = session.scalar(select(exists().where(NotificationRow.key == key)))
        if told_today or not _subscribers(session, Topic.DISK_LOW, now):
            return
    told = TOPICS[Topic.DISK_LOW]
    text = "\n".join([f"There are {free_mb:,.0f} MB left.", "", told.advice])
    with catalogue.writing() as session:
        _tell(session, Topic.DISK_LOW, key, told.singular, text, now)


def _tell(
    session: Session,
    topic: Topic,
    key: str,
    subject: str,
    text: str,
    now: datetime,
    *,
    campaign: str = "",
    since: datetime | None = None,
) -> None:
    """Enter a notification for each subscriber of a topic, since then or already, who was not told that."""
    for subscriber in _subscribers(session, topic, since or now):
        try:
            with session.begin_nested():
                session.add(
                    NotificationRow(
                        subscription_id=subscriber.id,
                        topic=topic.value,
                        campaign=campaign,
                        key=key,
                        subject=subject,
                        text=text,
                        created_at=now,
                        next_try_at=now,
                    )
                )
        except IntegrityError:
            continue  # another supervisor was faster


def _subscribers(session: Session, topic: Topic, since: datetime) -> Sequence[SubscriptionRow]:
    """Return who has subscribed to a topic by then."""
    rows = session.scalars(
        select(SubscriptionRow).where(SubscriptionRow.created_at <= since).order_by(SubscriptionRow.id)
    )
    return [row for row in rows if topic.value in row.topics]


def _line(text: str) -> str:
    """Return a text as one line that is not endless."""
    one = harmless(" ".join(text.split()))
    return one if len(one) <= _LONGEST_LINE else f"{one[: _LONGEST_LINE - 3]}..."
