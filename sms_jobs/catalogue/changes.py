"""Notes what has happened beside jobs, in the transaction of the change: neither is without the other."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.changes import ChangeRow
from sms_jobs.records.shown.changes import Followed
from sms_jobs.records.subject import Subject


def enter(session: Session, topic: Followed, name: str, campaign: str, state: str, message: str = "") -> None:
    """Note a change of something; see `records.shown.changes.Change`."""
    session.add(ChangeRow(topic=topic.value, name=name, campaign=campaign, state=state, message=message))


def of_recordings(
    session: Session, campaign: str, labels: Iterable[str], state: str, message: str = ""
) -> None:
    """Note a change of the planned recordings of some states."""
    for label in labels:
        enter(session, Followed.RECORDING, str(Subject(campaign, label)), campaign, state, message)


def of_schedule(session: Session, name: str, campaign: str, state: str, message: str = "") -> None:
    """Note a change of a schedule of a campaign, or of several, whose name is empty then."""
    enter(session, Followed.SCHEDULE, name, campaign, state, message)
