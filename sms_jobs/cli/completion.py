"""What the shell offers on Tab: campaigns, states, views, kinds and job ids of the home."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import typer
from sqlalchemy.orm import Session

from sms_jobs import bootstrap
from sms_jobs.catalogue import campaigns
from sms_jobs.errors import SmsError
from sms_jobs.jobs import inquiry
from sms_jobs.jobs.planning import PIPELINE
from sms_jobs.kinds import all_kinds
from sms_jobs.records.campaign import Campaign

_JOBS_OFFERED = 200

Offered = TypeVar("Offered", str, tuple[str, str])


def campaign_names(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the names of campaigns."""
    return _offer(context, incomplete, inquiry.campaign_names)


def state_labels(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the states of the campaign that is named on the line."""
    return _offer(context, incomplete, lambda session: [s.label for s in _campaign(session, context).states])


def view_names(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the views of the campaign that is named on the line."""
    return _offer(context, incomplete, lambda session: list(_campaign(session, context).views))


def job_ids(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Offer the latest jobs, each with what it is."""

    def jobs(session: Session) -> list[tuple[str, str]]:
        found = inquiry.list_jobs(session, limit=_JOBS_OFFERED)
        return [(job.id[: inquiry.SHORT], f"{job.kind} {job.subject} {job.state}") for job in found]

    return _offer(context, incomplete, jobs)


def kind_names(incomplete: str) -> list[tuple[str, str]]:
    """Offer the job kinds."""
    offered = [(PIPELINE, "all kinds but simulate")]
    offered += [(kind.name, kind.summary) for kind in all_kinds().values()]
    return [(name, summary) for name, summary in offered if name.startswith(incomplete)]


def _campaign(session: Session, context: typer.Context) -> Campaign:
    return campaigns.definition(campaigns.campaign_row(session, context.params.get("campaign") or ""))


def _offer(context: typer.Context, incomplete: str, ask: Callable[[Session], list[Offered]]) -> list[Offered]:
    home: Path | None = context.params.get("home")
    try:
        with bootstrap.services(home) as services, services.catalogue.reading() as session:
            offered = ask(session)
    except SmsError:
        # Nothing can be said on a half-typed line; the command itself will say what is wrong.
        return []
    return [o for o in offered if (o if isinstance(o, str) else o[0]).startswith(incomplete)]
