"""What a message starts: the one task.

Imported in the nursery, before the places are forked; which home, worker and queues they serve comes
through the environment.
"""

from __future__ import annotations

import logging
import os
import socket
from datetime import UTC, datetime
from functools import cache

from sms_jobs import settings as settings_file
from sms_jobs.bootstrap import open_archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.devices.stations import Stations
from sms_jobs.jobs.running.runner import Runner
from sms_jobs.workers.celery_app import ALL_QUEUES, RUN, WORKER_ID, WORKER_QUEUES, make_app, message_queue

SETTINGS = settings_file.load()
_queues = tuple(os.environ.get(WORKER_QUEUES, ",".join(ALL_QUEUES)).split(","))
_stations = Stations.of(SETTINGS)
app = make_app(SETTINGS, _stations.served(_queues))


def message_queues() -> set[str]:
    """Return the message queues that are served now; rigs come and go."""
    return {message_queue(queue) for queue in _stations.served(_queues)}


@cache
def _runner() -> Runner:
    """Open this process's own connections; called in the place, after the fork."""
    return Runner(
        catalogue=Catalogue(SETTINGS.catalogue_url),
        archive=open_archive(SETTINGS),
        queues=_queues,
        worker_id=os.environ[WORKER_ID],
        host=socket.gethostname(),
        threads=SETTINGS.threads,
        log_folder=SETTINGS.job_log_folder,
        stations=_stations,
        now=lambda: datetime.now(UTC),
        least_room_mb=SETTINGS.least_room_mb,
    )


@app.task(name=RUN, ignore_result=True)  # type: ignore[untyped-decorator]
def run(job_id: str) -> None:
    """Run queued jobs until there are none; `job_id` only says that there is at least one."""
    try:
        _runner().run_queued()
    except BaseException:
        # The beginning or end of a job could not be recorded in the catalogue. A process that lives on would
        # keep the job for ever; one that is gone tells the supervisor to run the job again.
        logging.getLogger(__name__).exception("process %d ends: its job may not have", os.getpid())
        os._exit(1)
