"""Sends a notification: a signed request to a webhook, or a mail. Only what was subscribed is ever called."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import smtplib
import ssl
from datetime import UTC, datetime
from email.message import EmailMessage
from email.utils import format_datetime

import httpx2

from sms_jobs.errors import ConfigurationError, NotDelivered
from sms_jobs.jobs.notifying.deliveries import Delivery
from sms_jobs.records.shown.notifications import WEBHOOK, Address, Notification
from sms_jobs.records.texts import harmless
from sms_jobs.settings import Settings

SCHEMA = 1
"""Version of what a webhook is sent."""
_PATIENCE_S = 10.0
_LONGEST_REASON = 200

# It tells every address that it calls, and those of webhooks often are passwords.
for _teller in ("httpx2", "httpcore2"):
    logging.getLogger(_teller).setLevel(logging.WARNING)


def send(settings: Settings, delivery: Delivery, now: datetime) -> None:
    """Send what was claimed.

    Raises
    ------
    NotDelivered
        The receiver does not answer, or does not take it. What it says holds no secret of ours.
    ConfigurationError
        The settings of the mail server do not do.
    InvalidInput
        The address that mail is to come from is none.
    """
    if delivery.address.channel == WEBHOOK:
        _call(settings, delivery, now)
    else:
        _mail(settings, delivery, now)


def require_mail(settings: Settings) -> None:
    """Raise `ConfigurationError` where the settings name no mail server, or would show it a password."""
    for name, value in (("smtp_host", settings.smtp_host), ("smtp_from", settings.smtp_from)):
        if not value:
            raise ConfigurationError(
                f"the setting '{name}' is empty, so no mail can be sent; see docs/notifications.md"
            )
    Address.mail(settings.smtp_from)
    if not (settings.smtp_user + settings.smtp_password.get_secret_value()).isascii():
        raise ConfigurationError(
            "'smtp_user' or 'smtp_password' has letters beyond ASCII, which mail servers do not take; "
            "choose another"
        )
    if settings.smtp_user and settings.smtp_security == "none":
        raise ConfigurationError(
            "'smtp_security' is none, which would send the password unencrypted; set it to "
            "starttls or tls, or leave out 'smtp_user'"
        )


def body_of(settings: Settings, notification: Notification) -> bytes:
    """Return what a webhook is sent of a notification, as JSON."""
    links = {"console": settings.console_url} if settings.console_url else {}
    told = {
        "schema": SCHEMA,
        "id": notification.id,
        "topic": notification.topic,
        "subject": notification.subject,
        "text": notification.text,
        "campaign": notification.campaign or None,
        "created_at": notification.created_at.isoformat(),
        "links": links,
    }
    return json.dumps(told, ensure_ascii=False).encode()


def signature(secret: str, timestamp: str, body: bytes) -> str:
    """Return the HMAC-SHA256 of a time and what was sent then, as it is in the header."""
    signed = timestamp.encode() + b"." + body
    return f"sha256={hmac.new(secret.encode(), signed, hashlib.sha256).hexdigest()}"


def _call(settings: Settings, delivery: Delivery, now: datetime) -> None:
    body, timestamp = body_of(settings, delivery.notification), str(int(now.timestamp()))
    headers = {
        "Content-Type": "application/json",
        "User-Agent": "sms_jobs",
        "Idempotency-Key": delivery.notification.id,
        "Sms-Timestamp": timestamp,
        "Sms-Signature": signature(delivery.secret, timestamp, body),
    }
    where = delivery.address
    try:
        status = asyncio.run(_posted(where.whole.get_secret_value(), body, headers))
    except (TimeoutError, httpx2.TimeoutException):
        raise NotDelivered(f"{where.shown} did not answer within {_PATIENCE_S:g} s") from None
    except (httpx2.HTTPError, httpx2.InvalidURL, OSError, UnicodeError) as error:
        raise NotDelivered(f"{where.shown} cannot be reached: {_reason(str(error), where)}") from None
    if 300 <= status < 400:
        raise NotDelivered(
            f"{where.shown} answered {status} and redirects elsewhere, which is not followed; subscribe "
            f"the address that it redirects to"
        )
    if not 200 <= status < 300:
        raise NotDelivered(f"{where.shown} answered {status}")


async def _posted(url: str, body: bytes, headers: dict[str, str]) -> int:
    """Return the status that a server answers; raise `TimeoutError` when all of it takes too long."""
    # Neither proxies nor passwords of the environment: nobody but the receiver is called.
    client = httpx2.AsyncClient(
        timeout=_PATIENCE_S, follow_redirects=False, trust_env=False, verify=ssl.create_default_context()
    )
    # One limit for everything: that of the client begins anew with every byte.
    async with (
        asyncio.timeout(_PATIENCE_S),
        client,
        client.stream("POST", url, content=body, headers=headers) as answer,
    ):
        return answer.status_code


def _mail(settings: Settings, delivery: Delivery, now: datetime) -> None:
    require_mail(settings)
    server = f"the mail server {settings.smtp_host}, port {settings.smtp_port},"
    try:
        with _connected(settings) as connection:
            if settings.smtp_user:
                connection.login(settings.smtp_user, settings.smtp_password.get_secret_value())
            connection.send_message(_letter(settings, delivery, now))
    except smtplib.SMTPAuthenticationError as error:
        # Its words may repeat what it was given.
        raise NotDelivered(
            f"{server} refused user and password ({error.smtp_code}); correct 'smtp_user' and 'smtp_password'"
        ) from None
    except smtplib.SMTPRecipientsRefused as error:
        code, words = next(iter(error.recipients.values()))
        said = words.decode(errors="replace") if isinstance(words, bytes) else words
        raise NotDelivered(
            f"{server} refused the recipient: {code} {_reason(said, delivery.address)}"
        ) from None
    except (smtplib.SMTPException, OSError, UnicodeError) as error:
        raise NotDelivered(f"{server} did not take it: {_reason(str(error), delivery.address)}") from None


def _connected(settings: Settings) -> smtplib.SMTP:
    """Return a connection that is safe to log in on, or to a server that needs no password."""
    host, port = settings.smtp_host, settings.smtp_port
    context = ssl.create_default_context()
    if settings.smtp_security == "tls":
        return smtplib.SMTP_SSL(host, port, timeout=_PATIENCE_S, context=context)
    connection = smtplib.SMTP(host, port, timeout=_PATIENCE_S)
    if settings.smtp_security == "starttls":
        try:
            connection.starttls(context=context)
        except BaseException:
            connection.close()
            raise
    return connection


def _letter(settings: Settings, delivery: Delivery, now: datetime) -> EmailMessage:
    told = delivery.notification
    letter = EmailMessage()
    letter["Subject"] = f"[sms] {told.subject}"
    letter["From"] = settings.smtp_from
    letter["To"] = delivery.address.whole.get_secret_value()
    letter["Date"] = format_datetime(now.astimezone(UTC))
    letter["Message-ID"] = f"<{told.id}@{settings.smtp_from.rpartition('@')[2]}>"
    letter["Auto-Submitted"] = "auto-generated"
    letter.set_content("\n".join(filter(None, [told.text, settings.console_url])) + "\n")
    return letter


def _reason(text: str, address: Address) -> str:
    """Return why, as one line without the address, which may be secret."""
    clean = text.replace(address.whole.get_secret_value(), address.shown)
    return harmless(" ".join(clean.split()))[:_LONGEST_REASON]
