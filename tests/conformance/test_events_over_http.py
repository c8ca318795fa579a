"""What happens to jobs is told to whoever listens, on both databases."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Iterator

import httpx2
import pytest
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import add_event
from support.over_http import app_of, listening, served

from sms_jobs import bootstrap
from sms_jobs.app.work import jobs
from sms_jobs.app.work.jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.web.following import Follower, Listener


@pytest.fixture
def services(deployment: Deployment) -> Iterator[Services]:
    """Services of a home with the jobs of a small campaign."""
    make_home(deployment.home, deployment.environment)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        with bootstrap.services(deployment.home, "web") as opened:
            jobs.submit(opened, Work("plate", ("simulate",)))
            yield opened


def message_of(event: dict[str, str]) -> str:
    """Return the message of an event."""
    return str(json.loads(event["data"])["message"])


def test_events_are_told_and_go_on_where_they_broke_off(services: Services) -> None:
    with served(app_of(services)) as client:
        with listening(client) as events:
            time.sleep(0.5)
            began = time.monotonic()
            with services.catalogue.writing() as session:
                add_event(session, "first")
            first = next(events)
            assert time.monotonic() - began < 2.0
        assert first["event"] == "job"
        told = json.loads(first["data"])
        assert (told["kind"], told["campaign"], told["message"]) == ("simulate", "plate", "first")
        with services.catalogue.writing() as session:
            for message in ("second", "third"):
                add_event(session, message)
        with listening(client, headers={"Last-Event-ID": first["id"]}) as events:
            assert [message_of(next(events)) for _ in range(2)] == ["second", "third"]
            with services.catalogue.writing() as session:
                add_event(session, "fourth")
            assert message_of(next(events)) == "fourth"


def test_everything_is_told_from_the_beginning_once(services: Services) -> None:
    with services.catalogue.writing() as session:
        last = [add_event(session, str(number)) for number in range(1200)][-1]
    with served(app_of(services)) as client, listening(client, headers={"Last-Event-ID": "0"}) as events:
        numbers = [json.loads(next(events)["data"])["number"] for _ in range(last)]
    assert numbers == list(range(1, last + 1))


def test_events_of_another_campaign_are_not_told(services: Services) -> None:
    with served(app_of(services)) as client:
        options = {"headers": {"Last-Event-ID": "0"}}
        with listening(client, params={"campaign": "plate"}, **options) as events:
            assert json.loads(next(events)["data"])["campaign"] == "plate"
        silent = listening(client, params={"campaign": "other"}, timeout=1.0, **options)
        with silent as events, pytest.raises(httpx2.ReadTimeout):
            next(events)


def test_an_event_that_is_committed_late_is_told(services: Services) -> None:
    if services.catalogue.dialect == "sqlite":
        pytest.skip("on SQLite one writes after the other")

    async def told() -> list[tuple[int, str]]:
        follower, listener = Follower(services), Listener(asyncio.get_running_loop())
        await asyncio.to_thread(follower.listen, listener)
        found = []
        try:
            with services.catalogue.writing() as late:
                number = add_event(late, "late")
                with services.catalogue.writing() as early:
                    add_event(early, "early")
                found += await listener.next(5.0)
                assert [cursor for cursor, _ in found] == [number - 1]
            found += await listener.next(5.0)
        finally:
            follower.leave(listener)
        return [(cursor - number, one.message) for cursor, one in found]

    # Who heard the early one alone goes on before the late one.
    assert asyncio.run(told()) == [(-1, "early"), (0, "late")]


def test_a_listener_who_does_not_listen_is_told_nothing_more(services: Services) -> None:
    async def crowded() -> bool:
        follower, listener = Follower(services), Listener(asyncio.get_running_loop())
        await asyncio.to_thread(follower.listen, listener)
        with services.catalogue.writing() as session:
            for number in range(2500):
                add_event(session, str(number))
        deadline = time.monotonic() + 20.0
        while not listener.dropped and time.monotonic() < deadline:
            await asyncio.sleep(0.05)
        follower.leave(listener)
        return listener.dropped

    assert asyncio.run(crowded())
