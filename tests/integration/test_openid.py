"""People come in by an identity provider; a token that cannot be trusted lets nobody in."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx2
import pytest
from fastapi.testclient import TestClient
from joserfc.jwk import RSAKey
from pydantic import SecretStr
from support.identity_provider import CLIENT, SECRET, Provider, provider
from support.people import SOMEBODY

from sms_jobs import bootstrap
from sms_jobs.app.accounts import openid, people
from sms_jobs.app.accounts.people import LoggedIn
from sms_jobs.bootstrap import Services
from sms_jobs.errors import ConfigurationError, Conflict, NotAllowed, ServerUnreachable
from sms_jobs.records.people import Role
from sms_jobs.web.application import application
from sms_jobs.web.protection import Options

BACK = "http://testserver/login/openid/return"


@pytest.fixture
def idp() -> Iterator[Provider]:
    with provider() as one:
        yield one


@pytest.fixture
def services(idp: Provider, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    monkeypatch.setenv("SMS_OPENID_ISSUER", idp.issuer)
    monkeypatch.setenv("SMS_OPENID_CLIENT_ID", CLIENT)
    monkeypatch.setenv("SMS_OPENID_CLIENT_SECRET", SECRET)
    bootstrap.initialise(tmp_path / "home")
    with bootstrap.services(tmp_path / "home") as opened:
        acting = opened.acting(SOMEBODY)
        people.add(acting, "boss", Role.ADMINISTRATOR, SecretStr("correct horse battery"))
        people.add(acting, "anna", Role.ANALYST)
        openid.set_identity(acting, "anna", "sub-anna")
        yield acting


def log_in(services: Services, change: Callable[[str], str] = str) -> LoggedIn:
    address, journey = openid.begin(services, BACK)
    back = httpx2.get(address, follow_redirects=False).headers["Location"]
    assert back.startswith(BACK)
    found = parse_qs(urlsplit(back).query)
    return openid.complete(services, journey, change(found["state"][0]), found["code"][0])


def test_whom_the_provider_knows_comes_in_as_the_person(services: Services) -> None:
    session = log_in(services)
    assert (session.name, session.role) == ("anna", Role.ANALYST)
    assert people.actor_of(services, session.secret, "192.0.2.7").name == "anna"


@pytest.mark.parametrize(
    "wrong",
    [
        {"nonce": "another"},
        {"aud": "another"},
        {"iss": "https://another.example"},
        {"exp": 1_000_000_000},
        {"azp": "another"},
        {"sub": None},
    ],
)
def test_a_token_for_something_else_is_refused(
    services: Services, idp: Provider, wrong: dict[str, object]
) -> None:
    idp.wrong = wrong
    with pytest.raises(NotAllowed, match="log in again"):
        log_in(services)


def test_a_token_of_another_key_is_refused(services: Services, idp: Provider) -> None:
    idp.published = RSAKey.generate_key(2048, {"kid": "1"})
    with pytest.raises(NotAllowed, match="cannot be trusted"):
        log_in(services)


@pytest.mark.parametrize("algorithm", ["HS256", "none"])
def test_a_token_that_anybody_can_make_is_refused(services: Services, idp: Provider, algorithm: str) -> None:
    idp.header = {"alg": algorithm, "kid": "1"}
    with pytest.raises(NotAllowed, match="cannot be trusted"):
        log_in(services)


def test_the_answer_to_another_log_in_is_refused(services: Services) -> None:
    with pytest.raises(NotAllowed, match="another log-in"):
        log_in(services, lambda state: state[::-1])


def test_whom_nobody_has_entered_is_told_how(services: Services, idp: Provider) -> None:
    idp.subject = "sub-stranger"
    with pytest.raises(NotAllowed, match="'sms person identity NAME sub-stranger'"):
        log_in(services)


def test_who_may_not_come_in_does_not(services: Services) -> None:
    people.set_active(services, "anna", False)
    with pytest.raises(NotAllowed):
        log_in(services)


def test_a_subject_is_one_person(services: Services) -> None:
    with pytest.raises(Conflict, match="is anna already"):
        openid.set_identity(services, "boss", "sub-anna")
    openid.set_identity(services, "anna", None)
    openid.set_identity(services, "boss", "sub-anna")
    assert log_in(services).name == "boss"


def test_a_browser_goes_there_and_comes_back(services: Services) -> None:
    app = application(services, Options(frozenset({"testserver"}), secure=False, desk=True))
    with TestClient(app, follow_redirects=False) as browser:
        assert "/login/openid?next=" in browser.get("/login?next=/jobs").text
        to_provider = browser.get("/login/openid?next=/jobs")
        back = httpx2.get(to_provider.headers["Location"], follow_redirects=False).headers["Location"]
        with TestClient(app) as other:
            assert other.get(back).status_code == 403  # another browser has begun nothing
        came = browser.get(back)
        assert came.headers["Refresh"] == "0; url=/jobs"
        assert "SameSite=strict" in came.headers["Set-Cookie"]
        assert browser.get("/api/v1/session").json()["name"] == "anna"
        assert browser.get(back).status_code == 403  # once


def test_a_provider_that_is_away_or_another_is_named(services: Services, idp: Provider) -> None:
    issuer, idp.issuer = idp.issuer, "https://another.example"
    with pytest.raises(ConfigurationError, match=r"calls itself 'https://another.example'"):
        openid.begin(services, BACK)
    idp.issuer = issuer


def test_a_provider_that_does_not_answer(services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    away = services.settings.model_copy(update={"openid_issuer": "http://127.0.0.1:9"})
    with pytest.raises(ServerUnreachable, match=r"127\.0\.0\.1:9 does not answer"):
        openid.begin(Services(away, services.catalogue, services.archive, SOMEBODY), BACK)
