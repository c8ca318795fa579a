"""What happens to jobs and beside them is told to whoever listens, on both databases."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator

import httpx2
import pytest
from support.deployments import Deployment
from support.homes import make_home
from support.jobs import add_event
from support.over_http import app_of, listening, served

from sms_jobs import bootstrap
from sms_jobs.app.work import happenings, new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import changes
from sms_jobs.records.shown.changes import Followed
from sms_jobs.web import following
from sms_jobs.web.following import Follower, Listener

JOBS = 2
"""Events of the jobs of the campaign."""


@pytest.fixture
def services(deployment: Deployment) -> Iterator[Services]:
    """Services of a home with the jobs of a small campaign."""
    make_home(deployment.home, deployment.environment)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        with bootstrap.services(deployment.home, "web") as opened:
            new_jobs.submit(opened, Work("plate", ("simulate",)))
            yield opened


def changes_so_far(services: Services) -> int:
    """Return the number of the newest change beside jobs: the campaign has brought a calibration."""
    return happenings.newest(services).changes


def message_of(event: dict[str, str]) -> str:
    """Return the message of an event."""
    return str(json.loads(event["data"])["message"])


def test_events_are_told_and_go_on_where_they_broke_off(services: Services) -> None:
    with served(app_of(services)) as client:
        with listening(client) as events:
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


def test_nothing_is_missed_after_the_first_sign_of_life(
    services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    listen = Follower.listen

    def slowly(follower: Follower, listener: Listener) -> happenings.Cursor:
        time.sleep(0.5)
        return listen(follower, listener)

    monkeypatch.setattr(Follower, "listen", slowly)
    with served(app_of(services)) as client, listening(client) as events:
        with services.catalogue.writing() as session:
            add_event(session, "first")
        assert message_of(next(events)) == "first"


def test_everything_is_told_from_the_beginning_once(services: Services) -> None:
    with services.catalogue.writing() as session:
        last = [add_event(session, str(number)) for number in range(1200)][-1]
    others = changes_so_far(services)
    with served(app_of(services)) as client, listening(client, headers={"Last-Event-ID": "0"}) as events:
        found = [next(events) for _ in range(last + others)]
    for wanted, count in ((True, last), (False, others)):
        numbers = [json.loads(one["data"])["number"] for one in found if (one["event"] == "job") is wanted]
        assert numbers == list(range(1, count + 1))


def test_events_of_another_campaign_are_not_told(services: Services) -> None:
    with served(app_of(services)) as client:
        options = {"headers": {"Last-Event-ID": f"0-{changes_so_far(services)}"}}
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
                assert [cursor.jobs for cursor, _ in found] == [number - 1]
            found += await listener.next(5.0)
        finally:
            follower.leave(listener)
            follower.end()
        return [(cursor.jobs - number, one.message) for cursor, one in found]

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
        follower.end()
        return listener.dropped

    assert asyncio.run(crowded())


def test_a_follower_that_ends_asks_nothing_more(services: Services) -> None:
    """A catalogue that is closed while it is asked would leave a connection open."""

    async def ended() -> tuple[int, int]:
        follower, listener = Follower(services), Listener(asyncio.get_running_loop())
        await asyncio.to_thread(follower.listen, listener)
        follower.end()
        late = Listener(asyncio.get_running_loop())
        await asyncio.to_thread(follower.listen, late)
        assert listener.dropped
        assert late.dropped
        return follower.listeners, followers()

    assert asyncio.run(ended()) == (0, 0)


def followers() -> int:
    """Return how many threads follow what happens."""
    return sum(thread.name == "follower" for thread in threading.enumerate())


def test_a_server_that_ends_waits_for_its_follower(
    services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It rests so long that it would still be there, and ask once more."""
    monkeypatch.setattr(following, "EVERY_S", 2.0)
    with served(app_of(services)) as client, listening(client) as events:
        with services.catalogue.writing() as session:
            add_event(session, "first")
        assert message_of(next(events)) == "first"
        assert followers() == 1
    assert followers() == 0


def change_of(services: Services, number: int) -> None:
    """Note a change beside jobs."""
    with services.catalogue.writing() as session:
        changes.enter(session, Followed.SCHEDULE, f"night-{number}", "", "fired", "submitted 3 jobs")


def test_what_happens_beside_jobs_has_a_name_and_numbers_of_its_own(services: Services) -> None:
    others = changes_so_far(services)
    change_of(services, 1)
    with served(app_of(services)) as client:
        with listening(client, headers={"Last-Event-ID": "0"}) as events:
            before = [next(events) for _ in range(JOBS + others + 1)]
        assert [one["event"] for one in before] == ["job"] * JOBS + ["calibration"] * others + ["schedule"]
        first = before[-1]
        told = json.loads(first["data"])
        assert (told["name"], told["state"], told["message"]) == ("night-1", "fired", "submitted 3 jobs")
        change_of(services, 2)
        with services.catalogue.writing() as session:
            add_event(session, "after")
        # Who goes on after the first change is told each once: the job's, then the second change.
        with listening(client, headers={"Last-Event-ID": first["id"]}) as events:
            then = [next(events) for _ in range(2)]
            change_of(services, 3)
            then.append(next(events))
        assert [json.loads(one["data"]).get("name", "job") for one in then] == ["job", "night-2", "night-3"]
        # A number alone, as an older page may send it, is of jobs; other changes are told again.
        alone = str(json.loads(then[0]["data"])["number"])
        with listening(client, headers={"Last-Event-ID": alone}) as events:
            again = [json.loads(next(events)["data"])["name"] for _ in range(others + 3)]
        assert again[others:] == ["night-1", "night-2", "night-3"]
        for wrong in ("-1", "1-", "1-2-3", "x", "1" * 19):
            assert client.get("events", headers={"Last-Event-ID": wrong}).status_code == 422, wrong


def test_what_is_about_no_one_campaign_is_told_to_those_of_each(services: Services) -> None:
    others = changes_so_far(services)
    change_of(services, 1)
    with services.catalogue.writing() as session:
        changes.of_recordings(session, "other", ["S01"], "held")
        changes.of_recordings(session, "plate", ["S01"], "held")
    with served(app_of(services)) as client:
        options = {"params": {"campaign": "plate"}, "headers": {"Last-Event-ID": f"1000000-{others}"}}
        with listening(client, **options) as events:
            names = [json.loads(next(events)["data"])["name"] for _ in range(2)]
    assert names == ["night-1", "plate/S01"]


def test_many_changes_beside_jobs_are_told_once_and_in_order(services: Services) -> None:
    others = changes_so_far(services)
    with services.catalogue.writing() as session:
        for number in range(1100):
            changes.of_schedule(session, f"night-{number}", "", "fired")
    begun = {"Last-Event-ID": f"0-{others}"}
    with served(app_of(services)) as client, listening(client, headers=begun) as events:
        found = [json.loads(next(events)["data"]) for _ in range(1100 + JOBS)]
    assert [one["name"] for one in found if "name" in one] == [f"night-{k}" for k in range(1100)]
    assert [one["number"] for one in found if "job" in one] == list(range(1, JOBS + 1))
