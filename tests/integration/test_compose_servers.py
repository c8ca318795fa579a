"""The servers of the compose file are reached by TLS with certificate and password, and not otherwise."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
import redis
from support.compose import PASSWORD, ComposeServers, compose_servers

from sms_jobs import bootstrap
from sms_jobs.settings import Settings
from sms_jobs.workers.celery_app import broker_answers


@pytest.fixture
def servers() -> Iterator[ComposeServers]:
    with compose_servers() as found:
        yield found


@pytest.mark.postgresql
@pytest.mark.redis
def test_the_servers_are_reached_by_tls_alone(servers: ComposeServers, tmp_path: Path) -> None:
    variables = tmp_path / "sms.env"
    variables.write_text(f"SMS_DATABASE_URL={servers.database_url}\nSMS_BROKER_URL={servers.broker_url}\n")
    settings: Settings = bootstrap.initialise(tmp_path / "home", variables)
    assert broker_answers(settings) is None
    with bootstrap.services(tmp_path / "home") as services, services.catalogue.reading() as session:
        (encrypted,) = session.connection().exec_driver_sql(
            "SELECT ssl FROM pg_stat_ssl WHERE pid = pg_backend_pid()"
        ).one()  # fmt: skip
        assert encrypted

    def connect(**options: str) -> None:
        psycopg.connect(
            host=servers.address, port=servers.postgresql_port, user="sms", dbname="sms", **options
        ).close()

    with pytest.raises(psycopg.OperationalError, match="no encryption"):
        connect(sslmode="disable", password=PASSWORD)
    with pytest.raises(psycopg.OperationalError, match="password authentication failed"):
        connect(sslmode="require", password="another")
    other = tmp_path / "other.crt"
    other.write_bytes(servers.authority.with_name("server.crt").read_bytes())
    with pytest.raises(psycopg.OperationalError, match="certificate verify failed"):
        connect(sslmode="verify-full", sslrootcert=str(other), password=PASSWORD)
    for url in (
        servers.broker_url.replace("rediss://", "redis://").partition("?")[0],
        servers.broker_url.replace(str(servers.authority), str(other)),
        servers.broker_url.replace(PASSWORD, "another"),
    ):
        with redis.Redis.from_url(url) as client, pytest.raises(redis.exceptions.ConnectionError):
            client.ping()
