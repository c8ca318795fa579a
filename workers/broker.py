"""Looks at the message broker: does it answer, and would it lose messages?"""

from __future__ import annotations

import redis

from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import broker_answers

_PATIENCE_S = 3.0


def examine(settings: Settings) -> tuple[str, str | None]:
    """Return what the broker is, with its version, and what is wrong with it, in words without a password."""
    url = settings.broker_url.get_secret_value()
    if not url.startswith(("redis://", "rediss://")):
        return "files in the home", broker_answers(settings)
    what = "Redis"
    try:
        with redis.Redis.from_url(
            url, socket_connect_timeout=_PATIENCE_S, socket_timeout=_PATIENCE_S
        ) as client:
            what = f"Redis {client.info('server')['redis_version']}"
            keeps = client.config_get("appendonly").get("appendonly")
            policy = client.config_get("maxmemory-policy").get("maxmemory-policy")
    except redis.exceptions.ResponseError:
        # Hosted servers often forbid to read the configuration.
        return what, None
    except (redis.exceptions.RedisError, OSError, ValueError) as error:
        return what, f"the broker does not answer ({type(error).__name__}); start it or correct broker_url"
    if keeps != "yes":
        return what, (
            "Redis keeps messages in memory alone (appendonly is no), so that a restart delays jobs; "
            "set 'appendonly yes' in redis.conf"
        )
    if policy != "noeviction":
        return what, (
            f"Redis throws messages away when it is full (maxmemory-policy is {policy}); set "
            "'maxmemory-policy noeviction' in redis.conf"
        )
    return what, None
