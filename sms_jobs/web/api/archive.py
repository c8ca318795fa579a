"""The archive: compared with what was sealed, and what would be repaired or removed."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated, Any

from fastapi import Request
from pydantic import Field

from sms_jobs.app.holdings import archive
from sms_jobs.records.shown.archive_state import ArchiveState
from sms_jobs.web.identity import Acting
from sms_jobs.web.long_work import MEDIA, followed
from sms_jobs.web.request_bodies import RequestBody, Text
from sms_jobs.web.routes import Routes, answer

ROUTES = Routes("archive")


class Verification(RequestBody):
    """Which files are compared, and how."""

    campaign: Annotated[Text | None, Field(description="Only its files.")] = None
    quick: Annotated[bool, Field(description="Look at presence and size alone.")] = False
    after: Annotated[int, Field(ge=0, le=2**31 - 1, description="Go on after the file of this number.")] = 0


class Mending(RequestBody):
    """How files are compared before it is said what would be repaired."""

    quick: Annotated[bool, Field(description="Look at presence and size alone.")] = False


class Retention(RequestBody):
    """What counts as old."""

    days: Annotated[float, Field(ge=0, le=1e5, description="Only what is older.")]
    kinds: Annotated[list[Text], Field(max_length=100, description="Only results of these.")] = []


@ROUTES.offer("GET", "/archive/state", archive.state, answers=ArchiveState)
def state(services: Acting) -> Any:
    """Return what was verified when, what is due, and what is damaged."""
    return answer(archive.state(services))


@ROUTES.offer("POST", "/archive/verify", archive.verify, media=(MEDIA,))
async def verify(request: Request, services: Acting, body: Verification) -> Any:
    """Compare the archive with the catalogue, and tell how far that has come."""
    return await followed(
        request,
        lambda tell: archive.verify(
            services, campaign=body.campaign, quick=body.quick, after=body.after, tell=tell
        ),
    )


@ROUTES.offer("POST", "/archive/repairs", archive.repair, media=(MEDIA,))
async def repairs(request: Request, services: Acting, body: Mending) -> Any:
    """Say what would be repaired; nothing is changed."""
    return await followed(
        request, lambda tell: archive.repair(services, dry_run=True, quick=body.quick, tell=tell)
    )


@ROUTES.offer("POST", "/archive/removable", archive.remove_old)
def removable(services: Acting, body: Retention) -> Any:
    """Say what would be removed as old; nothing is changed."""
    found = archive.remove_old(services, timedelta(days=body.days), body.kinds, dry_run=True)
    return answer({"files": found.files, "frames": found.frames, "bytes": found.size_bytes})
