"""Notifications: who is told what, and whether it has arrived."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from datetime import UTC, datetime

from pydantic import SecretStr

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput, NotDelivered, SmsError
from sms_jobs.jobs.notifying import deliveries
from sms_jobs.records.people import Right
from sms_jobs.records.shown.notifications import MAIL, WEBHOOK, Address, SentView, SubscriptionView, Topic

_SHORTEST_SECRET = 16
_LONGEST_SECRET = 200


@use_case(Right.ADMINISTER)
def add(
    services: Services,
    name: str,
    address: Address,
    topics: Sequence[Topic],
    secret: SecretStr | None = None,
) -> SecretStr | None:
    """Subscribe an address to topics, under a name.

    Parameters
    ----------
    secret
        That signs what a webhook is sent; one is made where it is None.

    Returns
    -------
    The secret of a webhook, which is never shown again; None for mail.

    Raises
    ------
    InvalidInput
        The name cannot be one, no topic is given, or the secret is too short or not for mail.
    ConfigurationError
        Mail cannot be sent: the settings name no server for it.
    Conflict
        There is a subscription of that name.
    """
    # What sends takes longer to load than most of these commands.
    from sms_jobs.jobs.notifying.sending import require_mail

    if not topics:
        raise InvalidInput(f"no topic is given; choose among {', '.join(t.value for t in Topic)}")
    if address.channel == MAIL:
        require_mail(services.settings)
        if secret is not None:
            raise InvalidInput("mail is not signed, so it has no secret; leave it out")
    signing = _checked(secret) if address.channel == WEBHOOK else SecretStr("")
    with services.catalogue.writing() as session:
        deliveries.subscribe(
            session,
            name,
            address,
            signing.get_secret_value(),
            list(dict.fromkeys(topics)),
            datetime.now(UTC),
        )
    return signing if address.channel == WEBHOOK else None


def _checked(secret: SecretStr | None) -> SecretStr:
    if secret is None:
        return SecretStr(secrets.token_urlsafe(32))
    length = len(secret.get_secret_value())
    if not _SHORTEST_SECRET <= length <= _LONGEST_SECRET:
        raise InvalidInput(
            f"the secret has {length} letters; give one of {_SHORTEST_SECRET} to {_LONGEST_SECRET}, or let "
            "one be made"
        )
    return secret


@use_case(Right.ADMINISTER)
def remove(services: Services, name: str) -> None:
    """End a subscription, and forget what it was sent; raise `NotFound` where there is none."""
    with services.catalogue.writing() as session:
        deliveries.unsubscribe(session, name)


@use_case(Right.READ)
def subscriptions(services: Services) -> list[SubscriptionView]:
    """Return who is told what, without what is secret."""
    with services.catalogue.reading() as session:
        return deliveries.subscriptions(session)


@use_case(Right.READ)
def sent(services: Services, name: str | None = None, *, limit: int = 50) -> list[SentView]:
    """Return what was sent, waits or was given up, the newest first.

    Raises `NotFound` where there is no such subscription.
    """
    with services.catalogue.reading() as session:
        return deliveries.sent(session, name, limit)


@use_case(Right.ADMINISTER)
def test(services: Services, name: str) -> str:
    """Send a subscriber a message now, once; return where it was sent.

    Raises
    ------
    NotFound
        There is no such subscription.
    NotDelivered
        It was not taken; the message says why.
    ConfigurationError
        Mail cannot be sent: the settings name no server for it.
    """
    from sms_jobs.jobs.notifying import sending

    with services.catalogue.writing() as session:
        claimed = deliveries.claim_test(session, name, datetime.now(UTC))
    if claimed is None:
        raise NotDelivered(f"the subscription '{name}' changed meanwhile; try again")
    failure: SmsError | None = None
    try:
        sending.send(services.settings, claimed, datetime.now(UTC))
    except SmsError as error:
        failure = error
    with services.catalogue.writing() as session:
        deliveries.settle(session, claimed, None if failure is None else str(failure), datetime.now(UTC))
    if failure is not None:
        raise failure
    return claimed.address.shown
