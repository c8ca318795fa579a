"""Looks at the message broker: does it answer, and would it lose messages?"""

from __future__ import annotations

import secrets
from contextlib import suppress

import redis

from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import broker_answers

_PATIENCE_S = 3.0


def examine(settings: Settings) -> tuple[str, str | None]:
    """Return what the broker is, with its version, and what is wrong with it, in words without a password."""
    url = settings.broker_url.get_secret_value()
    if not url.startswith(("redis://", "rediss://")):
        return "files in the home", broker_answers(settings) or _file_that_cannot_be_sent(settings)
    what = "Redis"
    try:
        with redis.Redis.from_url(
            url, socket_connect_timeout=_PATIENCE_S, socket_timeout=_PATIENCE_S
        ) as client:
            what = f"Redis {client.info('server')['redis_version']}"
            return what, _message_that_cannot_be_sent(client) or _message_that_may_be_lost(client)
    except (redis.exceptions.RedisError, OSError, ValueError) as error:
        return what, f"the broker does not answer ({type(error).__name__}); start it or correct broker_url"


def _file_that_cannot_be_sent(settings: Settings) -> str | None:
    # No message, to those who read this folder.
    trial = settings.message_folder / "queue" / f"doctor-{secrets.token_hex(4)}"
    try:
        trial.write_bytes(b"can this be sent?")
    except OSError as error:
        return (
            f"no message can be sent through {trial.parent} ({error.strerror}), so that no job is started; "
            "make room there, and give the service's account permission to write"
        )
    finally:
        with suppress(OSError):
            trial.unlink(missing_ok=True)
    return None


def _message_that_cannot_be_sent(client: redis.Redis) -> str | None:
    """Do once what sending a message does: push to a list."""
    trial = f"sms.doctor.{secrets.token_hex(4)}"
    try:
        client.lpush(trial, "can this be sent?")
        client.delete(trial)
    except redis.exceptions.NoPermissionError:
        return None  # an account for the service's own keys alone
    except redis.exceptions.ResponseError as error:
        full = isinstance(error, redis.exceptions.OutOfMemoryError)
        hint = (
            "raise 'maxmemory' in redis.conf, or remove what else it holds"
            if full
            else "look at its log, and at the room on its disk"
        )
        return (
            f"Redis takes no messages ({str(error).splitlines()[0]}), so no job is started; {hint}: jobs "
            "are not lost, and start by themselves then"
        )
    return None


def _message_that_may_be_lost(client: redis.Redis) -> str | None:
    try:
        keeps = client.config_get("appendonly").get("appendonly")
        policy = client.config_get("maxmemory-policy").get("maxmemory-policy")
    except redis.exceptions.ResponseError:
        return None  # hosted servers often forbid to read the configuration
    if keeps != "yes":
        return (
            "Redis keeps messages in memory alone (appendonly is no), so that a restart delays jobs; "
            "set 'appendonly yes' in redis.conf"
        )
    if policy != "noeviction":
        return (
            f"Redis throws messages away when it is full (maxmemory-policy is {policy}); set "
            "'maxmemory-policy noeviction' in redis.conf"
        )
    return None
