"""Some jobs, named by what they have in common: a query for them stays short, however many they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import TYPE_CHECKING

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from sms_jobs.catalogue import campaigns, job_counts
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import InvalidInput
from sms_jobs.records.job import ACTIVE

if TYPE_CHECKING:
    from sms_jobs.jobs.planning.submission import Submission

MOST_NAMED = 1000
"""Jobs that may be named one by one: the number of values of a statement is limited."""


@dataclass(frozen=True)
class Chosen:
    """Some jobs; with nothing given, all.

    Attributes
    ----------
    ids
        They alone.
    campaign_id, kind
        Of this campaign and kind.
    submitted_at
        Of the submission of that moment.
    submitted_until
        Submitted until that moment.
    ended_before
        How many of them had ended in each state before and are not meant.
    """

    ids: tuple[str, ...] | None = None
    campaign_id: int | None = None
    kind: str | None = None
    submitted_at: datetime | None = None
    submitted_until: datetime | None = None
    ended_before: Mapping[str, int] = field(default_factory=dict)

    @property
    def of_kept_counts(self) -> bool:
        """Whether the counts that the catalogue keeps tell how many they are."""
        return self.ids is None and self.submitted_at is None and self.submitted_until is None

    @property
    def where(self) -> tuple[ColumnElement[bool], ...]:
        """What the rows of `job` have in common; those that had ended before are among them."""
        conditions = (
            None if self.ids is None else JobRow.id.in_(self.ids),
            None if self.campaign_id is None else JobRow.campaign_id == self.campaign_id,
            None if self.kind is None else JobRow.kind == self.kind,
            None if self.submitted_at is None else JobRow.submitted_at == self.submitted_at,
            None if self.submitted_until is None else JobRow.submitted_at <= self.submitted_until,
        )
        return tuple(condition for condition in conditions if condition is not None)


def by_ids(ids: Sequence[str]) -> Chosen:
    """Choose jobs one by one; raise `InvalidInput` where they are too many for that."""
    if len(ids) > MOST_NAMED:
        raise InvalidInput(
            f"{len(ids)} jobs are named, and at most {MOST_NAMED} can be; choose a `campaign` instead"
        )
    return Chosen(ids=tuple(ids))


def submitted(done: Submission, kind: str | None = None) -> Chosen:
    """Choose the jobs of a submission, or those of a kind among them."""
    return Chosen(campaign_id=done.campaign_id, kind=kind, submitted_at=done.submitted_at)


def of_campaign(session: Session, campaign: str | None) -> Chosen:
    """Choose the jobs of a campaign, or all."""
    return Chosen(campaign_id=None if campaign is None else campaigns.campaign_id(session, campaign))


def active_now(session: Session, campaign: str | None = None) -> Chosen:
    """Choose the jobs of a campaign, or all, that have not ended; what is submitted later is not meant."""
    scope = of_campaign(session, campaign)
    latest = session.scalar(
        select(func.max(JobRow.submitted_at)).where(*scope.where, JobRow.state.in_(ACTIVE))
    )
    if latest is None:
        return Chosen(ids=())
    scope = Chosen(campaign_id=scope.campaign_id, submitted_until=latest)
    active = {state.value for state in ACTIVE}
    ended = {state: n for state, n in by_state(session, scope).items() if state not in active}
    return replace(scope, ended_before=ended)


def by_state(session: Session, chosen: Chosen) -> dict[str, int]:
    """Return how many rows of `job` are in each state, those that had ended before among them."""
    if chosen.of_kept_counts:
        some = None if chosen.campaign_id is None else [chosen.campaign_id]
        return job_counts.by_state(session, some, chosen.kind)
    query = select(JobRow.state, func.count()).where(*chosen.where).group_by(JobRow.state)
    return {state.value: count for state, count in session.execute(query)}
