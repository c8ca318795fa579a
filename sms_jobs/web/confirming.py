"""Deeds that ask for the password again, and for a reason."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, SecretStr

from sms_jobs.app.accounts import people
from sms_jobs.bootstrap import Services
from sms_jobs.web.request_bodies import RequestBody, Text

Reason = Annotated[Text, Field(description="Why it is done; the audit keeps it.")]
Password = Annotated[SecretStr, Field(strict=False, max_length=1024)]


class Confirmed(RequestBody):
    """What comes with the password of whoever asks, and with a reason."""

    password: Annotated[
        Password | None, Field(description="Not needed from the desk before anybody has a name.")
    ] = None
    reason: Reason = ""


def confirmed(services: Services, body: Confirmed) -> Services:
    """Return the services for somebody who has given the password again, and says why.

    Without a password the use case asks for it. Raises `NotAllowed` for a wrong one.
    """
    if body.password is not None and not services.actor.confirmed:
        services = people.confirmed(services, body.password)
    return services.because(body.reason)
