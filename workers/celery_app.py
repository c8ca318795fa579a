"""The Celery application: JSON messages that carry a job id, over files or Redis."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlsplit

from celery import Celery
from kombu.entity import Queue as MessageQueue
from kombu.exceptions import OperationalError

from sms_jobs.errors import ConfigurationError
from sms_jobs.jobs.devices.stations import EVERY_RIG
from sms_jobs.kinds.kind import Queue
from sms_jobs.settings import Settings
from sms_jobs.workers import file_transport

RUN = "sms_jobs.run"
"""Name of the one task that there is."""

WORKER_ID = "SMS_WORKER_ID"
WORKER_QUEUES = "SMS_WORKER_QUEUES"
"""Environment variables by which a supervisor tells its worker who it is and what it serves."""

QUEUES = tuple(queue.value for queue in Queue)
"""Of every host."""
ALL_QUEUES = (*QUEUES, EVERY_RIG)


def message_queue(queue: str) -> str:
    """Return the name of the message queue of a job queue."""
    return f"sms.{queue}"


def make_app(settings: Settings, queues: Sequence[str] = QUEUES) -> Celery:
    """Build the application for a home.

    Raises
    ------
    ConfigurationError
        The broker is neither files nor Redis.
    """
    url = settings.broker_url.get_secret_value()
    app = Celery("sms_jobs")
    message_queues = [MessageQueue(message_queue(queue)) for queue in queues]  # type: ignore[no-untyped-call]
    app.conf.update(
        task_queues=message_queues,
        task_default_queue=message_queue(QUEUES[0]),
        task_serializer="json",
        accept_content=["json"],
        task_ignore_result=True,
        # Recovery never goes through the broker: a message that is lost is rung again.
        task_acks_late=False,
        worker_prefetch_multiplier=1,
        # Nobody asks: what a worker does is seen by its supervisor, and what jobs do by the catalogue.
        worker_enable_remote_control=False,
        worker_hijack_root_logger=False,
        worker_redirect_stdouts=False,
        broker_connection_retry_on_startup=True,
        **(_over_redis(url) if url else _over_files(settings)),
    )
    return app


def _over_files(settings: Settings) -> dict[str, object]:
    messages = settings.message_folder / "queue"
    control = settings.message_folder / "control"
    for folder in (messages, control):
        folder.mkdir(parents=True, exist_ok=True)
    return {
        "broker_url": f"{file_transport.SCHEME}://localhost",
        "broker_transport_options": {
            "data_folder_in": str(messages),
            "data_folder_out": str(messages),
            "control_folder": str(control),
            "polling_interval": 0.05,
        },
    }


def _has_sound_port(url: str) -> bool:
    try:
        return urlsplit(url).port != 0
    except ValueError:
        return False


def _over_redis(url: str) -> dict[str, object]:
    if not (url.startswith(("redis://", "rediss://", "redis+socket://")) and _has_sound_port(url)):
        # Not what was given: a password may stand anywhere in it.
        raise ConfigurationError(
            "broker_url names no broker that is served; write redis://HOST:PORT/NUMBER, or leave it empty "
            "for files in the home"
        )
    if url.startswith("rediss://") and "ssl_cert_reqs=" not in url:
        # Celery would take any certificate.
        url += f"{'&' if '?' in url else '?'}ssl_cert_reqs=required"
    # Longer than any job: a message that Redis redelivers would only wake a worker for nothing.
    return {"broker_url": url, "broker_transport_options": {"visibility_timeout": 86_400}}


def broker_answers(settings: Settings) -> str | None:
    """Return what is wrong with the broker, in words that repeat no password; None when it answers."""
    try:
        with make_app(settings).connection_for_write() as connection:
            connection.ensure_connection(max_retries=1, timeout=3.0)
    except (OSError, OperationalError) as error:
        return f"the broker does not answer ({type(error).__name__}); start it or correct broker_url"
    return None
