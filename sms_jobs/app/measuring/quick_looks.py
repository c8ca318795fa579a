"""What quick looks at recorded states have found."""

from __future__ import annotations

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.jobs.recording import quick_looks
from sms_jobs.records.people import Right
from sms_jobs.records.shown.quick_looks import QuickLookView


@use_case(Right.READ)
def show(services: Services, campaign: str) -> list[QuickLookView]:
    """Return the newest quick look at each tuple of a campaign; raise `NotFound` where there is none."""
    with services.catalogue.reading() as session:
        return quick_looks.looks(session, campaign)
