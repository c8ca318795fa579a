"""The newest files about a subject."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.states import LoadStateRow
from sms_jobs.records.subject import Subject


def newest_file(session: Session, source: str, subject: Subject, media_type: str) -> int | None:
    """Return the newest file of a type that is a measurement or result of a kind about a subject."""
    return session.scalar(_files(source, subject, media_type).with_only_columns(func.max(FileRow.id)))


def files_newest_first(session: Session, source: str, subject: Subject, media_type: str) -> Iterator[int]:
    """Yield all files of which `newest_file` returns the first."""
    yield from session.scalars(_files(source, subject, media_type).order_by(FileRow.id.desc()))


def _files(source: str, subject: Subject, media_type: str) -> Select[Any]:
    query = (
        select(FileRow.id)
        .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .where(
            FileRow.source == source,
            FileRow.media_type == media_type,
            CampaignRow.name == subject.campaign,
        )
    )
    if subject.state is None:
        query = query.where(FileRow.state_id.is_(None))
    else:
        query = query.join(LoadStateRow, LoadStateRow.id == FileRow.state_id).where(
            LoadStateRow.label == subject.state
        )
    return query.where(FileRow.view.is_(None) if subject.view is None else FileRow.view == subject.view)
