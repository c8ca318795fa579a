"""Notifications: who is told what by mail or webhook, and whether it has arrived."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from sms_jobs.app.accounts import notifications
from sms_jobs.errors import InvalidInput
from sms_jobs.records.shown.notifications import Address, Topic
from sms_jobs.web.identity import Acting
from sms_jobs.web.request_bodies import Limit, Name, RequestBody, Text
from sms_jobs.web.routes import Routes, answer, returned

ROUTES = Routes("notifications")

Topics = Annotated[list[Annotated[Topic, Field(strict=False)]], Field(min_length=1, max_length=len(Topic))]


class NewSubscription(RequestBody):
    """Somebody who is to be told, by mail or by webhook."""

    name: Text
    topics: Topics
    mail: Text | None = None
    webhook: Annotated[Text | None, Field(description="https, or http on the host that serves.")] = None

    @property
    def address(self) -> Address:
        """Where; raises `InvalidInput` unless one of both is given."""
        if self.mail is not None and self.webhook is None:
            return Address.mail(self.mail)
        if self.webhook is not None and self.mail is None:
            return Address.webhook(self.webhook)
        raise InvalidInput("give a target: either mail or webhook")


@ROUTES.offer(
    "GET", "/notifications", notifications.subscriptions, answers=returned(notifications.subscriptions)
)
def subscriptions(services: Acting) -> Any:
    """Return who is told what."""
    return answer(notifications.subscriptions(services))


@ROUTES.offer("POST", "/notifications", notifications.add, answers=dict[str, str | int | None], status=201)
def add(services: Acting, body: NewSubscription) -> Any:
    """Subscribe someone to events; the secret of a webhook is shown only once."""
    address = body.address
    secret = notifications.add(services, body.name, address, body.topics)
    shown = None if secret is None else secret.get_secret_value()
    return answer({"subscription": body.name, "where": address.shown, "secret": shown}, 201)


@ROUTES.offer("GET", "/notifications/sent", notifications.sent, answers=returned(notifications.sent))
def sent(services: Acting, name: Text | None = None, limit: Limit = 50) -> Any:
    """Return what was sent, waits or was given up."""
    return answer(notifications.sent(services, name, limit=limit))


@ROUTES.offer("POST", "/notifications/{name}/test", notifications.test, answers=dict[str, str | int])
def test(services: Acting, name: Name) -> Any:
    """Send a message now, and say where it went."""
    return answer({"sent": notifications.test(services, name)})


@ROUTES.offer("DELETE", "/notifications/{name}", notifications.remove, answers=dict[str, str | int])
def remove(services: Acting, name: Name) -> Any:
    """Remove a subscription."""
    notifications.remove(services, name)
    return answer({"removed": name})
