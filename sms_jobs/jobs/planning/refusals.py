"""What is refused of planned jobs because of what is recorded or made already: what could only fail."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from sms_jobs.archive import DATASET_MEDIA_TYPE, Archive
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.subject_files import newest_file
from sms_jobs.jobs.planning import gauge_places, image_regions
from sms_jobs.jobs.planning.graph import Existing, PlannedJob, Request, plan
from sms_jobs.kinds.kind import Need


def check_jobs(session: Session, archive: Archive, campaign: str, jobs: Sequence[PlannedJob]) -> None:
    """Refuse jobs whose gauges no view can read, or whose regions have no pixel; `InvalidInput`."""
    image_regions.check_regions(session, archive, campaign, jobs)
    gauge_places.check_gauges(session, archive, campaign, jobs)


def check_requests(session: Session, archive: Archive, campaign: str, requests: Sequence[Request]) -> None:
    """Refuse requests as `check_jobs` refuses the jobs that they would come to now; `InvalidInput`.

    Nothing else has to be there yet.
    """
    defined = definition(campaign_row(session, campaign))
    given = {name.rpartition(".")[2] for request in requests for name in request.parameters}
    given |= {name for declared in defined.processing.values() for name in declared}
    looked_at = {gauge_places.IN_PIXELS, *image_regions.REGIONS.values()}
    if given.isdisjoint(looked_at) and not any(one.kind in gauge_places.KINDS for one in requests):
        return

    def find(need: Need) -> Existing:
        return Existing(newest_file(session, need.source, need.subject, DATASET_MEDIA_TYPE) or 0)

    check_jobs(session, archive, campaign, plan(defined, requests, find))
