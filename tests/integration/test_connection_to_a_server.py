"""The Python interface and its server: who may ask, what is told of errors, and servers that are away."""

from __future__ import annotations

import socketserver
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr
from support.homes import make_home
from support.serving import free_port, serving

import sms_jobs
from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.errors import (
    CommitInDoubt,
    ConfigurationError,
    InvalidInput,
    NotAllowed,
    ServerUnreachable,
    SmsError,
)
from sms_jobs.lab import connection
from sms_jobs.records.people import Role

PASSWORD = "a password of some length"


@pytest.fixture(autouse=True)
def little_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "_PATIENCE_S", 1.0)


@pytest.fixture
def home(home: Path) -> Path:
    make_home(home, {})
    return home


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("lab.example.org", "no address"),
        ("ftp://lab.example.org", "no address"),
        ("https://lab.example.org/?token=x", "no address"),
        ("http://lab.example.org", "not encrypted"),
        ("https://me:secret-word@lab.example.org", "give a token"),
    ],
)
def test_an_address_that_cannot_be_one_is_refused(url: str, words: str) -> None:
    with pytest.raises(InvalidInput, match=words) as refused:
        sms_jobs.connect(url, "t" * 20)
    assert "secret-word" not in str(refused.value)


@pytest.mark.parametrize("token", ["", "two words", "line\nbreak", "caf\u00e9-token"])
def test_a_token_that_cannot_be_one_is_refused_and_not_repeated(token: str) -> None:
    with pytest.raises(InvalidInput, match="token has characters") as refused:
        sms_jobs.connect("https://127.0.0.1:1", token)
    assert not token or token not in str(refused.value)


def test_a_token_opens_and_shows_nowhere(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with bootstrap.services(home) as services:
        people.add(services, "root", Role.ADMINISTRATOR, SecretStr(PASSWORD))
        people.add(services, "vera", Role.VIEWER, SecretStr(PASSWORD))
        session = people.log_in(services, "vera", SecretStr(PASSWORD))
        vera = services.acting(people.actor_of(services, session.secret, "127.0.0.1"))
        token = people.create_token(people.confirmed(vera, SecretStr(PASSWORD)), "notebook").secret
    with serving(home) as url:
        with pytest.raises(NotAllowed, match="you are not logged in"):
            sms_jobs.connect(url)
        with pytest.raises(NotAllowed) as refused:
            sms_jobs.connect(url, "wrong-token")
        assert "wrong-token" not in str(refused.value)
        with sms_jobs.connect(url, token) as lab:
            assert token not in repr(lab) + repr(vars(lab)) + repr(vars(lab._source))
            assert len(lab.find("calibration")) == 1
            with pytest.raises(NotAllowed, match="vera is viewer and may not compute"):
                lab.submit("simulate", "plate")
    told = capfd.readouterr()
    assert token not in told.out + told.err


def test_a_server_that_is_away_for_a_moment_is_waited_for(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "_PATIENCE_S", 60.0)
    port = free_port()
    with serving(home, port=port) as url:
        lab = sms_jobs.connect(url)
    found: list[int] = []
    asking = threading.Thread(target=lambda: found.append(len(lab.find("calibration"))))
    asking.start()
    time.sleep(0.5)
    assert not found
    with serving(home, port=port):
        asking.join(timeout=30.0)
    assert found == [1]
    lab.close()


def test_a_server_that_stays_away_is_an_error(home: Path) -> None:
    with serving(home) as url:
        lab = sms_jobs.connect(url)
    began = time.monotonic()
    with pytest.raises(ServerUnreachable, match=f"{url} does not answer"):
        lab.find()
    assert time.monotonic() - began < 5.0
    with pytest.raises(ServerUnreachable, match="does not answer"):
        lab.submit("simulate", "plate")
    lab.close()


class _Answers(BaseHTTPRequestHandler):
    """A stranger in the place of the server."""

    asked: list[str]
    status: int

    def _answer(self) -> None:
        self.asked.append(f"{self.command} {self.path}")
        if self.command == "POST":
            self.connection.close()
            return
        self.send_response(self.status)
        self.send_header("Content-Length", "2")
        self.end_headers()
        self.wfile.write(b"{}")

    do_GET = do_POST = _answer  # noqa: N815 - as the standard library calls them

    def log_message(self, *_: Any) -> None:
        pass


@contextmanager
def stranger(status: int) -> Iterator[tuple[str, list[str]]]:
    asked: list[str] = []
    handler = type("_Own", (_Answers,), {"asked": asked, "status": status})
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", asked
        finally:
            server.shutdown()
            thread.join()


def test_reads_are_tried_again_and_changes_are_not() -> None:
    with stranger(503) as (url, asked):
        with pytest.raises(ServerUnreachable, match="status 503"):
            sms_jobs.connect(url)
        assert len(asked) > 1
    with stranger(200) as (url, asked):
        with sms_jobs.connect(url) as lab, pytest.raises(CommitInDoubt, match="may be done or not"):
            lab.submit("simulate", "plate")
        assert asked.count("POST /api/v1/jobs") == 1


def test_something_else_that_answers_is_told_from_the_server() -> None:
    with stranger(418) as (url, _), pytest.raises(SmsError, match="status 418; is it sms_jobs"):
        sms_jobs.connect(url)


def test_only_a_certificate_that_is_trusted_is_spoken_to(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    subject = ["-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1"]
    new = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *subject]
    subprocess.run([*new, "-keyout", str(key), "-out", str(certificate)], check=True, capture_output=True)
    options = ("--tls-key", str(key), "--tls-certificate", str(certificate))
    with serving(home, options=options) as url:
        with pytest.raises(ConfigurationError, match=r"is not trusted.*SSL_CERT_FILE"):
            sms_jobs.connect(url)
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with sms_jobs.connect(url) as lab:
            assert len(lab.find("calibration")) == 1
