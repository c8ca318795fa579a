"""What the shell offers on Tab: campaigns, states, views, kinds and job ids of the home.

Every command knows these functions, and few runs of one call them: they import what they ask themselves.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.errors import SmsError
from sms_jobs.records.job import SHORT_ID

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

EVERYTHING = "pipeline"
_JOBS_OFFERED = 200

Offered = TypeVar("Offered", str, tuple[str, str])


def campaign_names(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the names of campaigns."""
    from sms_jobs.app.specimens import campaigns

    return _offer(context, incomplete, campaigns.names)


def state_labels(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the states of the campaign that is named on the line."""
    return _offer(
        context, incomplete, lambda services: [s.label for s in _campaign(services, context).states]
    )


def view_names(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the views of the campaign that is named on the line."""
    return _offer(context, incomplete, lambda services: list(_campaign(services, context).views))


def job_ids(context: typer.Context, incomplete: str) -> list[tuple[str, str]]:
    """Offer the latest jobs, each with what it is."""
    from sms_jobs.app.work import jobs

    def latest(services: Services) -> list[tuple[str, str]]:
        found = jobs.list_jobs(services, limit=_JOBS_OFFERED)
        return [(job.id[:SHORT_ID], f"{job.kind} {job.subject} {job.state}") for job in found]

    return _offer(context, incomplete, latest)


def run_names(context: typer.Context, incomplete: str) -> list[str]:
    """Offer the names of runs."""
    from sms_jobs.app.work import runs

    return _offer(context, incomplete, lambda services: [run.name for run in runs.list_runs(services)])


def kind_names(incomplete: str) -> list[tuple[str, str]]:
    """Offer the job kinds, as `ops/kinds_lock.py` has listed them: to import all of them takes seconds."""
    kinds = json.loads(resources.files(__package__).joinpath("kinds.json").read_text("utf-8"))
    offered = [(EVERYTHING, "all kinds but simulate"), *kinds.items()]
    return [(name, summary) for name, summary in offered if name.startswith(incomplete)]


def _campaign(services: Services, context: typer.Context) -> Campaign:
    from sms_jobs.app.specimens import campaigns

    return campaigns.definition(services, context.params.get("campaign") or "")


def _offer(
    context: typer.Context, incomplete: str, ask: Callable[[Services], list[Offered]]
) -> list[Offered]:
    home: Path | None = context.params.get("home")
    try:
        with bootstrap.services(home) as services:
            offered = ask(services)
    except SmsError:
        # Nothing can be said on a half-typed line; the command itself will say what is wrong.
        return []
    return [o for o in offered if (o if isinstance(o, str) else o[0]).startswith(incomplete)]
