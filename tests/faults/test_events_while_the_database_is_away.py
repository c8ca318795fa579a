"""Who listens to events stays connected while the database is away, and misses nothing."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from support.homes import make_home
from support.jobs import add_event
from support.over_http import app_of, listening, served
from support.servers import PostgresqlServer

from sms_jobs import bootstrap
from sms_jobs.app.work import new_jobs
from sms_jobs.app.work.new_jobs import Work


@pytest.mark.parametrize("away_s", [3.0, pytest.param(30.0, marks=pytest.mark.long)])
def test_a_listener_outlives_an_outage_of_the_database(
    server: PostgresqlServer, home: Path, monkeypatch: pytest.MonkeyPatch, away_s: float
) -> None:
    environment = {"SMS_DATABASE_URL": server.url}
    make_home(home, environment)
    monkeypatch.setenv("SMS_DATABASE_URL", server.url)
    with bootstrap.services(home, "web") as services:
        new_jobs.submit(services, Work("plate", ("simulate",)))
        with served(app_of(services)) as client, listening(client) as events:
            server.crash()
            time.sleep(away_s)
            assert client.get("jobs").status_code == 503
            server.start()
            with services.catalogue.writing() as session:
                add_event(session, "back")
            assert json.loads(next(events)["data"])["message"] == "back"
