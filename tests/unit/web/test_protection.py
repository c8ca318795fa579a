"""Pages of other sites, other names and endless bodies are refused before anything is read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.work import queues
from sms_jobs.web.application import application
from sms_jobs.web.protection import Options

PAUSE = "/api/v1/queues/pause"
CPU = {"names": ["cpu"], "reason": "lunch"}


@pytest.fixture
def services(tmp_path: Path) -> Iterator[bootstrap.Services]:
    initialised(tmp_path / "home")
    with bootstrap.services(tmp_path / "home", "web") as opened:
        yield opened


@pytest.fixture
def client(services: bootstrap.Services) -> Iterator[TestClient]:
    app = application(services, Options(frozenset({"testserver"}), secure=False, desk=True))
    with TestClient(app, client=("127.0.0.1", 50_000)) as one:
        yield one


def paused(services: bootstrap.Services) -> list[str]:
    return [queue.name for queue in queues.list_queues(services) if queue.paused_at is not None]


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://testserver:81"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Cookie": "sms_session=anything"},
    ],
)
def test_a_change_that_another_site_asks_for_is_refused(
    client: TestClient, services: bootstrap.Services, headers: dict[str, str]
) -> None:
    answer = client.post(PAUSE, json=CPU, headers=headers)
    assert answer.status_code == 403
    assert "another site" in answer.json()["error"]
    assert paused(services) == []


@pytest.mark.parametrize("headers", [{}, {"Origin": "http://testserver"}, {"Sec-Fetch-Site": "same-origin"}])
def test_a_change_that_this_site_or_a_program_asks_for_is_made(
    client: TestClient, services: bootstrap.Services, headers: dict[str, str]
) -> None:
    assert client.post(PAUSE, json=CPU, headers=headers).json() == {"schema": 1, "paused": ["cpu"]}
    assert paused(services) == ["cpu"]


def test_another_name_is_refused(client: TestClient) -> None:
    # As by a page whose name was made to lead to this machine.
    answer = client.get("/api/v1/queues", headers={"Host": "evil.example"})
    assert answer.status_code == 403
    assert "evil.example" in answer.json()["error"]


@pytest.mark.parametrize("name", ["Host", "Origin"])
def test_what_is_no_address_is_refused(client: TestClient, services: bootstrap.Services, name: str) -> None:
    answer = client.post(PAUSE, json=CPU, headers={name: "http://[" if name == "Origin" else "["})
    assert answer.status_code == 422
    assert "no address" in answer.json()["error"]
    assert paused(services) == []


def test_an_endless_body_is_refused(client: TestClient, services: bootstrap.Services) -> None:
    announced = client.post(PAUSE, content=b"{}", headers={"Content-Length": str(1 << 40)})
    assert announced.status_code == 413
    assert "larger than 16 MB" in announced.json()["error"]
    unannounced = client.post(PAUSE, content=(b" " * (1 << 20) for _ in range(20)))
    assert unannounced.status_code == 413
    assert paused(services) == []


def test_nobody_is_at_the_desk_who_comes_over_a_network(services: bootstrap.Services) -> None:
    app = application(services, Options(frozenset({"testserver"}), secure=False, desk=True))
    with TestClient(app, client=("192.0.2.7", 50_000)) as far:
        answer = far.get("/api/v1/queues")
    assert answer.status_code == 401
    assert answer.headers["WWW-Authenticate"] == "Bearer"
    behind = application(services, Options(frozenset({"testserver"}), secure=True, desk=False))
    with TestClient(behind, client=("127.0.0.1", 50_000)) as proxied:
        assert proxied.get("/api/v1/queues").status_code == 401


def test_a_browser_may_do_nothing_else_with_an_answer(client: TestClient) -> None:
    for path in ("/api/v1/queues", "/api/v1/nothing", "/nowhere"):
        headers = client.get(path).headers
        assert "default-src 'none'" in headers["Content-Security-Policy"]
        assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
        assert "unsafe" not in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Cache-Control"] == "no-store"
