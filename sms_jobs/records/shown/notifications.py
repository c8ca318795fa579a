"""What people are told without asking, and where it is sent."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from ipaddress import ip_address
from typing import Final
from urllib.parse import urlsplit

from pydantic import SecretStr

from sms_jobs.errors import InvalidInput
from sms_jobs.records.job import JobState
from sms_jobs.records.texts import NAME_LETTERS

WEBHOOK: Final = "webhook"
MAIL: Final = "mail"
TEST: Final = "test"
"""Topic of what is sent once to see whether it arrives; nobody subscribes to it."""

_LONGEST_URL = 2_000
_LONGEST_MAIL = 254
_HOST = re.compile(r"[a-z0-9]([a-z0-9._-]{0,251}[a-z0-9])?|[0-9a-f:]+")
_MAIL = re.compile(r"[A-Za-z0-9_+][A-Za-z0-9._%+-]{0,63}@[A-Za-z0-9-]+(\.[A-Za-z0-9-]+)*")


class Topic(Enum):
    """What can be subscribed to; `TOPICS` says what each is."""

    JOB_FAILED = "job-failed"
    JOB_QUARANTINED = "job-quarantined"
    NEEDS_OPERATOR = "needs-operator"
    QUEUE_DONE = "queue-done"
    SCHEDULE_MISSED = "schedule-missed"
    DISK_LOW = "disk-low"
    LIMIT_REACHED = "limit-reached"


@dataclass(frozen=True)
class Wording:
    """How a topic is told.

    Attributes
    ----------
    meaning
        When it is.
    singular, plural
        Of a campaign, as the subject of a message; empty for a topic that is about none.
    advice
        Where to look next.
    state
        Of a job, whose change to it is told; None for what is no change of a job.
    """

    meaning: str
    singular: str
    plural: str
    advice: str
    state: JobState | None = None


TOPICS: Mapping[Topic, Wording] = {
    Topic.JOB_FAILED: Wording(
        "a job has failed",
        "a job of {campaign} has failed",
        "{count} jobs of {campaign} have failed",
        "'sms job list -c {campaign} --state failed' shows them",
        JobState.FAILED,
    ),
    Topic.JOB_QUARANTINED: Wording(
        "a job has brought its worker down too often and is held back",
        "a job of {campaign} is quarantined",
        "{count} jobs of {campaign} are quarantined",
        "'sms job list -c {campaign} --state quarantined' shows them",
        JobState.QUARANTINED,
    ),
    Topic.NEEDS_OPERATOR: Wording(
        "a recording was interrupted, or an instrument gave up, and waits for a person",
        "a job of {campaign} needs an operator",
        "{count} jobs of {campaign} need an operator",
        "look at the rig; 'sms job list -c {campaign} --state needs-operator' shows them",
        JobState.NEEDS_OPERATOR,
    ),
    Topic.QUEUE_DONE: Wording(
        "jobs have run, and for a minute none has been left that could",
        "the queue is done",
        "the queue is done",
        "'sms status' shows how everything stands",
    ),
    Topic.SCHEDULE_MISSED: Wording(
        "a schedule's time passed without its jobs, or they could not be submitted",
        "a schedule of {campaign} missed its time",
        "schedules of {campaign} missed {count} times",
        "'sms schedule list' shows them",
    ),
    Topic.DISK_LOW: Wording(
        "the archive's disk has little room left, or queues wait for room; once a day",
        "the archive's disk has little room left",
        "the archive's disk has little room left",
        "free some space, or see 'sms archive gc --help'",
    ),
    Topic.LIMIT_REACHED: Wording(
        "the quick look at a recorded state is beyond a limit, and its plan is held",
        "the plan of {campaign} is held by a quick look",
        "the plan of {campaign} is held by {count} quick looks",
        "look at the specimen; 'sms acquire plan show {campaign}' tells why",
    ),
}

OF_STATES: Mapping[JobState, Topic] = {
    told.state: topic for topic, told in TOPICS.items() if told.state is not None
}


@dataclass(frozen=True)
class Address:
    """Where a subscriber is.

    Attributes
    ----------
    channel
        `webhook` or `mail`.
    shown
        As it may be told: of a webhook without path and query, which often are a password.
    whole
        As it is called.
    """

    channel: str
    shown: str
    whole: SecretStr

    @classmethod
    def webhook(cls, url: str) -> Address:
        """Return that of a web server; it has to be `https`, or `http` on this host.

        Raises
        ------
        InvalidInput
            It is not such an address, or holds a name and password.
        """
        try:
            parts = urlsplit(url)
            host, port = parts.hostname or "", parts.port
        except ValueError as error:
            raise InvalidInput("the webhook's address cannot be read; write https://HOST/PATH") from error
        if len(url) > _LONGEST_URL or not re.fullmatch(r"[!-~]+", url):
            raise InvalidInput(
                f"the webhook's address has letters that no address has, or more than {_LONGEST_URL}; "
                "write https://HOST/PATH"
            )
        if parts.username is not None or parts.password is not None:
            raise InvalidInput(
                f"the webhook's address at {host} holds a name or password; leave them out: what is sent is "
                "signed"
            )
        if not _HOST.fullmatch(host):
            raise InvalidInput(
                f"the webhook's host '{host[:NAME_LETTERS]}' is not valid; write https://HOST/PATH"
            )
        if not (parts.scheme == "https" or (parts.scheme == "http" and _is_this_host(host))):
            raise InvalidInput(
                f"a webhook at '{parts.scheme}://{host}' would be unencrypted; give an address that "
                f"starts with https://, or with http://127.0.0.1 on this host"
            )
        place = f"[{host}]" if ":" in host else host
        more = "/..." if parts.path.strip("/") or parts.query else ""
        shown = f"{parts.scheme}://{place}" + ("" if port is None else f":{port}") + more
        return cls(WEBHOOK, shown, SecretStr(url))

    @classmethod
    def mail(cls, address: str) -> Address:
        """Return that of a mailbox; raise `InvalidInput` where it is none."""
        if len(address) > _LONGEST_MAIL or not _MAIL.fullmatch(address):
            raise InvalidInput(
                f"'{address[:NAME_LETTERS]}' is no address of one mailbox; write it like ops@lab.example"
            )
        return cls(MAIL, address, SecretStr(address))

    @classmethod
    def stored(cls, channel: str, whole: str) -> Address:
        """Return one that was accepted before."""
        return cls.webhook(whole) if channel == WEBHOOK else cls.mail(whole)


def _is_this_host(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Notification:
    """Something that a subscriber is told.

    Attributes
    ----------
    id
        The same whenever it is sent again.
    topic
        One of `Topic`, or `test`.
    subject
        One line.
    text
        Some lines.
    campaign
        That it is about; empty for none.
    """

    id: str
    topic: str
    subject: str
    text: str
    campaign: str
    created_at: datetime


@dataclass(frozen=True)
class SubscriptionView:
    """A subscription as it is shown.

    Attributes
    ----------
    where
        Without what is secret.
    waiting, given_up
        How many messages have still to be sent, and were given up.
    """

    name: str
    channel: str
    where: str
    topics: tuple[str, ...]
    created_at: datetime
    waiting: int
    given_up: int


@dataclass(frozen=True)
class SentView:
    """What became of a notification.

    Attributes
    ----------
    state
        `sent`, `waits`, or `given up`.
    tries
        How often it was tried.
    next_try_at
        None where it is not tried any more.
    error
        Why it did not arrive the last time; None where it did.
    """

    subscription: str
    topic: str
    subject: str
    created_at: datetime
    state: str
    tries: int
    next_try_at: datetime | None
    sent_at: datetime | None
    error: str | None
