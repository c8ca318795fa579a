"""Who may use which address: every one has a rule, and keeps to it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import httpx2
import pytest
from pydantic import SecretStr
from support.homes import make_home
from support.over_http import API, app_of, served

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.records.people import RIGHTS, Actor, Right, Role

_NOTHING_OF_THE_HOME = {("get", "")}
"""Lists the addresses alone."""
_TO_COME_IN = {("post", "/session"), ("delete", "/session")}
_PASSWORD = SecretStr("correct horse battery")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx2.Client, dict[Role, str]]]:
    """A client of a home in which somebody has each role, and their tokens."""
    folder = tmp_path_factory.mktemp("home")
    make_home(folder, {})
    with bootstrap.services(folder, "web") as services:
        tokens = {}
        for role in reversed(Role):  # the first has to be an administrator
            people.add(services, f"the-{role.value}", role, _PASSWORD)
            known = services.acting(Actor(f"the-{role.value}", role, "command", "here"))
            tokens[role] = people.create_token(known, "test").secret
        with served(app_of(services)) as client:
            yield client, tokens


def operations(client: httpx2.Client) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield method, path below `/api/v1` and description of every address."""
    for path, methods in client.get("/openapi.json").json()["paths"].items():
        for method, described in methods.items():
            yield method, path.removeprefix(API), described


def status(client: httpx2.Client, method: str, path: str, token: str | None) -> tuple[int, str]:
    """Return the status of an answer, and which refusal it is; events are listened to no longer than that."""
    filled = re.sub(r"\{(upload)\}", "u" + "0" * 24, path)
    filled = re.sub(r"\{(number|key)\}", "999", filled)
    filled = re.sub(r"\{[^}]*\}", "none", filled)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    body = {} if method in ("get", "delete") else {"json": {}}
    with client.stream(method, filled, headers=headers, **body) as answer:
        kind = "" if answer.status_code < 400 else str(answer.read() and answer.json()["kind"])
        return answer.status_code, kind


def test_every_address_has_a_rule(home: tuple[httpx2.Client, dict[Role, str]]) -> None:
    without = {(method, path) for method, path, said in operations(home[0]) if "x-use-case" not in said}
    assert without == _NOTHING_OF_THE_HOME


@pytest.mark.parametrize("role", Role)
def test_an_address_is_for_those_with_the_right(
    home: tuple[httpx2.Client, dict[Role, str]], role: Role
) -> None:
    client, tokens = home
    found, expected = {}, {}
    for method, path, said in operations(client):
        if said.get("x-right") is None:
            continue
        code, kind = status(client, method, path, tokens[role])
        found[method, path] = code != 401 and kind != "NotAllowed"
        expected[method, path] = Right(said["x-right"]) in RIGHTS[role]
    assert len(found) > 60
    assert found == expected


def test_nobody_comes_in_without_a_token(home: tuple[httpx2.Client, dict[Role, str]]) -> None:
    client, _ = home
    let_in = {
        (method, path)
        for method, path, _ in operations(client)
        if status(client, method, path, None)[0] != 401
    }
    assert let_in == _NOTHING_OF_THE_HOME | _TO_COME_IN
    assert status(client, "get", "/status", "sms_none")[0] == 401


def test_a_session_is_begun_and_ended(home: tuple[httpx2.Client, dict[Role, str]]) -> None:
    client, _ = home
    with httpx2.Client(base_url=client.base_url) as browser:
        said = {"name": "the-analyst", "password": _PASSWORD.get_secret_value()}
        # A browser says where its pages come from.
        own = {"Origin": str(client.base_url).removesuffix(f"{API}/")}
        begun = browser.post("session", json=said, headers=own)
        assert begun.status_code == 200
        assert "HttpOnly" in begun.headers["Set-Cookie"]
        assert "SameSite=strict" in begun.headers["Set-Cookie"]
        assert _PASSWORD.get_secret_value() not in begun.text
        assert browser.get("session").json()["rights"] == ["read", "own", "compute"]
        assert browser.post("queues/pause", json={"names": []}, headers=own).status_code == 403
        assert (
            browser.post("jobs/cancel", json={}, headers={"Origin": "https://else.where"}).status_code == 403
        )
        cookie = browser.cookies["sms_session"]
        assert browser.delete("session", headers=own).status_code == 204
        browser.cookies.set("sms_session", cookie)
        assert browser.get("session").status_code == 401


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("calibrations/certify", {"session": "boards"}),
        ("calibrations/77/use", {"in_use": True}),
        ("calibrations/77/use", {"in_use": False, "campaign": "plate"}),
    ],
    ids=["certify", "accept", "withdraw"],
)
def test_what_calibration_is_used_asks_for_the_password_again(
    home: tuple[httpx2.Client, dict[Role, str]], path: str, body: dict[str, Any]
) -> None:
    client, tokens = home
    headers = {"Authorization": f"Bearer {tokens[Role.METROLOGIST]}"}

    def decide(**more: str) -> httpx2.Response:
        return client.post(path, json={**body, **more}, headers=headers)

    assert decide().json()["kind"] == "PasswordNeeded"
    assert decide(password="not this one").json()["kind"] == "NotAllowed"
    # Confirmed: now it is the session or the calibration that is missing.
    assert decide(password=_PASSWORD.get_secret_value()).json()["kind"] == "NotFound"
