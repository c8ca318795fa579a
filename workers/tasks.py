"""What runs inside a Celery worker: the one task, and what each of its processes sets up.

Started by the supervisor as `celery -A sms_jobs.workers.tasks worker`; which home, worker and queues it
serves comes through the environment.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import Any

import cv2
from celery.signals import worker_init, worker_process_init, worker_ready

from sms_jobs import settings as settings_file
from sms_jobs.archive import Archive
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.jobs.runner import Runner
from sms_jobs.jobs.stations import Stations
from sms_jobs.kinds import all_kinds
from sms_jobs.workers.celery_app import ALL_QUEUES, RUN, WORKER_ID, WORKER_QUEUES, make_app, message_queue

_settings = settings_file.load()
_queues = tuple(os.environ.get(WORKER_QUEUES, ",".join(ALL_QUEUES)).split(","))
_stations = Stations.of(_settings)
app = make_app(_settings, _stations.served(_queues))

_LOOK_FOR_RIGS_EVERY_S = 1.0


@cache
def _runner() -> Runner:
    """Open this process's own connections; called in the child, after the fork."""
    return Runner(
        catalogue=Catalogue(_settings.catalogue_url),
        archive=Archive(_settings.archive_root),
        queues=_queues,
        worker_id=os.environ[WORKER_ID],
        host=socket.gethostname(),
        lease=timedelta(seconds=_settings.lease_s),
        threads=_settings.threads,
        log_folder=_settings.job_log_folder,
        stations=_stations,
        now=lambda: datetime.now(UTC),
        least_room_mb=_settings.least_room_mb,
    )


@app.task(name=RUN, ignore_result=True)  # type: ignore[untyped-decorator]
def run(job_id: str) -> None:
    """Run queued jobs until there are none; `job_id` only says that there is at least one."""
    try:
        _runner().run_queued()
    except BaseException:
        # The catalogue could not be told how a job ended, or whether it began. A process that lives on would
        # keep the job's lease for ever; one that is gone tells the supervisor to run the job again.
        logging.getLogger(__name__).exception("process %d ends: its job may not have", os.getpid())
        os._exit(1)


@worker_init.connect  # type: ignore[untyped-decorator]
@worker_process_init.connect  # type: ignore[untyped-decorator]
def _prepare_process(**_: Any) -> None:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(process)d %(message)s")
    cv2.setNumThreads(_settings.threads)
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()


@worker_init.connect  # type: ignore[untyped-decorator]
def _load_kinds(**_: Any) -> None:
    # Once, before the fork: a process that takes the place of a killed one has them at once.
    all_kinds()


@worker_ready.connect  # type: ignore[untyped-decorator]
def _serve_rigs_that_come(sender: Any, **_: Any) -> None:
    threading.Thread(target=_watch_rigs, args=(sender,), daemon=True).start()


def _watch_rigs(consumer: Any) -> None:
    """Have the worker be woken for rigs that are connected while it runs."""
    while True:
        for queue in map(message_queue, _stations.served(_queues)):
            if queue not in app.amqp.queues.consume_from:
                consumer.call_soon(_consume, consumer, queue)
        time.sleep(_LOOK_FOR_RIGS_EVERY_S)


def _consume(consumer: Any, queue: str) -> None:
    if consumer.task_consumer is not None:  # or it connects just now, and is asked again
        consumer.add_task_queue(queue)


def _end_with_parent(parent: int) -> None:
    # Without its supervisor a worker would run jobs that nobody renews: their results would be refused.
    while os.getppid() == parent:
        time.sleep(0.5)
    logging.getLogger(__name__).error("process %d, which looked after this one, is gone: ending", parent)
    os._exit(1)
