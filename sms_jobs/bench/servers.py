"""Deployments for benchmarks: PostgreSQL is an empty database on the server that the environment names."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.pool import NullPool

POSTGRESQL = "SMS_TEST_POSTGRESQL_URL"
REDIS = "SMS_TEST_REDIS_URL"


@contextmanager
def fresh_postgresql() -> Iterator[str | None]:
    """Give the URL of an empty database that is removed afterwards; None where no server is named."""
    server = os.environ.get(POSTGRESQL)
    if not server:
        yield None
        return
    name = f"sms_bench_{uuid.uuid4().hex}"
    engine = create_engine(server, isolation_level="AUTOCOMMIT", poolclass=NullPool)
    _run(engine, f"CREATE DATABASE {name}")
    try:
        yield make_url(server).set(database=name).render_as_string(hide_password=False)
    finally:
        _run(engine, f"DROP DATABASE {name} WITH (FORCE)")


def _run(engine: Engine, statement: str) -> None:
    with engine.connect() as connection:
        connection.execute(text(statement))


@contextmanager
def environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Let settings be those of a deployment for a while."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
