"""One place: a process that listens for messages as a Celery worker of its own, and runs jobs itself.

Celery's solo pool runs a task in the process that has heard of it. A place that works holds no message that
an idle one could hear, and nothing is shared with another place that a killed one could leave locked.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from typing import Any, NoReturn

import cv2
import scipy.optimize  # noqa: F401 - with what is above, for all places that are forked
from celery.worker import WorkController
from celery.worker.consumer import Consumer

from sms_jobs.workers.board import Board
from sms_jobs.workers.celery_app import WORKER_ID
from sms_jobs.workers.tasks import SETTINGS, app, message_queues

logger = logging.getLogger(__name__)

_RETRY_BROKER_EVERY_S = 1.0
_LOOK_FOR_RIGS_EVERY_S = 1.0


def serve(board: Board, line: int, lifeline: int) -> NoReturn:
    """Be one place until the board says to end; never returns.

    Parameters
    ----------
    board, line
        Where this process gives its signs of life.
    lifeline
        A pipe that nobody writes to: it ends with the supervisor.
    """
    status = 1
    try:
        board.enter(line, os.getpid())
        logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(process)d %(message)s")
        cv2.setNumThreads(SETTINGS.threads)
        threading.Thread(target=end_with_supervisor, args=(lifeline,), daemon=True).start()
        _Listener.board, _Listener.line = board, line
        worker = _Worker(
            app=app,
            hostname=f"sms-{os.environ[WORKER_ID]}-{line}@%h",
            pool_cls="solo",
            consumer_cls=_Listener,
            concurrency=1,
            loglevel="WARNING",
            without_gossip=True,
            without_mingle=True,
            without_heartbeat=True,
        )
        worker.start()
    except _EndRequested:
        status = 0
    except BaseException:
        logger.exception("process %d ends", os.getpid())
    finally:
        # Whatever the nursery has set up is the nursery's to take down.
        os._exit(status)


class _EndRequested(BaseException):
    """A place ends between two messages, with nothing to tidy up. Celery would outlive an `Exception`."""


class _Worker(WorkController):  # type: ignore[misc]
    """Celery's worker without its signals: SIGTERM ends a place at once, as it ends any process."""

    def should_use_eventloop(self) -> bool:
        """Use the plain loop for Redis too: each turn of it passes `perform_pending_operations`."""
        return False


class _Listener(Consumer):  # type: ignore[misc]
    """Celery's consumer that tells, turn by turn, that it listens."""

    board: Board
    line: int
    _look_for_rigs_at = 0.0

    def perform_pending_operations(self) -> None:
        """Give a sign of life; end where the supervisor wishes it, or has put another in this place."""
        self._beat()
        self._listen_to_rigs_that_came()
        super().perform_pending_operations()

    def _listen_to_rigs_that_came(self) -> None:
        now = time.monotonic()
        if now < self._look_for_rigs_at or self.task_consumer is None:
            return
        self._look_for_rigs_at = now + _LOOK_FOR_RIGS_EVERY_S
        for queue in message_queues() - set(self.app.amqp.queues.consume_from):
            self.add_task_queue(queue)

    def ensure_connected(self, conn: Any) -> Any:
        """Connect, and as long as no broker answers try again soon, giving signs of life meanwhile."""
        return conn.ensure_connection(
            self._say, None, _RETRY_BROKER_EVERY_S, 0.0, _RETRY_BROKER_EVERY_S, callback=self._beat
        )

    def _beat(self) -> None:
        if not self.board.beat(self.line) or self.board.draining:
            raise _EndRequested

    @staticmethod
    def _say(error: Exception, interval: float) -> None:
        logger.warning("the broker does not answer (%s); trying again", type(error).__name__)


def end_with_supervisor(lifeline: int) -> None:
    """End this process once its supervisor is gone; for a thread of its own."""
    # Without its supervisor a place would run jobs that nobody vouches for: their results would be refused.
    os.read(lifeline, 1)
    logger.error("the supervisor of process %d is gone: ending", os.getpid())
    os._exit(1)
