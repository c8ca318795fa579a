"""What is sent to real servers of the test's own, what is refused, and that no secret is told on the way."""

from __future__ import annotations

import hashlib
import hmac
import logging
import socketserver
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr
from sqlalchemy import select
from support.command import answer, inside
from support.receivers import MailServer, certificate, running, tls, webhook

from sms_jobs import bootstrap
from sms_jobs.app.accounts import notifications
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.audit import AuditRow
from sms_jobs.errors import ConfigurationError, Conflict, InvalidInput, NotAllowed, NotDelivered, NotFound
from sms_jobs.jobs.notifying import sending
from sms_jobs.jobs.notifying.deliveries import Delivery
from sms_jobs.records.people import Actor, Role
from sms_jobs.records.shown.notifications import Address, Notification, Topic
from sms_jobs.settings import Settings

NO_HOME = Path("/nowhere")
PATH = "/services/T0/sesame-path?token=sesame-token"
SECRET = "sesame-that-signs-everything"
PASSWORD = "sesame-of-the-mail-server"
SUBJECT = "5 jobs of plate have failed"
LETTER = Notification("0123abcd", "job-failed", SUBJECT, "- one\n- µ", "plate", datetime.now(UTC))


@pytest.fixture
def services(home: Path) -> Iterator[Services]:
    bootstrap.initialise(home)
    with bootstrap.services(home) as opened:
        yield opened


def delivery(address: Address) -> Delivery:
    return Delivery(1, 1, "night", address, SECRET, LETTER)


def call(url: str) -> None:
    sending.send(Settings(home=NO_HOME), delivery(Address.webhook(url)), datetime.now(UTC))


def by_mail(port: int, **others: object) -> Settings:
    given = {"smtp_host": "127.0.0.1", "smtp_port": port, "smtp_from": "sms@lab.example"}
    return Settings.model_validate({"home": NO_HOME, "smtp_security": "none", **given, **others})


def write_to(settings: Settings) -> None:
    sending.send(settings, delivery(Address.mail("ops@lab.example")), datetime.now(UTC))


def test_a_webhook_is_sent_signed_json() -> None:
    with webhook() as server:
        settings = Settings(home=NO_HOME, console_url="https://sms.lab.example")
        sending.send(settings, delivery(Address.webhook(server.url + PATH)), datetime.now(UTC))
        (got,) = server.requests
    assert got.path == PATH
    assert got.headers["Content-Type"] == "application/json"
    assert got.headers["Idempotency-Key"] == LETTER.id
    timestamp = got.headers["Sms-Timestamp"]
    assert abs(int(timestamp) - time.time()) < 60
    expected = hmac.new(SECRET.encode(), timestamp.encode() + b"." + got.body, hashlib.sha256).hexdigest()
    assert got.headers["Sms-Signature"] == f"sha256={expected}"
    assert got.told == {
        "schema": 1,
        "id": LETTER.id,
        "topic": "job-failed",
        "subject": LETTER.subject,
        "text": LETTER.text,
        "campaign": "plate",
        "created_at": LETTER.created_at.isoformat(),
        "links": {"console": "https://sms.lab.example"},
    }


def test_a_receiver_that_judges_as_the_page_says_takes_what_is_genuine_alone() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "notifications.md").read_text(encoding="utf-8")
    told: dict[str, Any] = {}
    exec(page.partition("```python\n")[2].partition("```")[0], told)
    with webhook() as server:
        call(server.url)
    (got,) = server.requests
    assert told["is_genuine"](SECRET, got.headers, got.body)
    assert not told["is_genuine"]("another", got.headers, got.body)
    assert not told["is_genuine"](SECRET, got.headers, got.body + b" ")
    old = got.headers | {"Sms-Timestamp": str(int(got.headers["Sms-Timestamp"]) - 400)}
    assert not told["is_genuine"](SECRET, old, got.body)
    signed = sending.signature(SECRET, old["Sms-Timestamp"], got.body)
    assert not told["is_genuine"](SECRET, old | {"Sms-Signature": signed}, got.body)  # sent again by somebody


@pytest.mark.parametrize("status", [301, 302, 307, 308, 404, 500])
def test_a_webhook_that_does_not_take_it_is_called_once_and_no_other(status: int) -> None:
    with webhook(status) as server:
        with pytest.raises(NotDelivered, match=f"answered {status}") as refused:
            sending.send(
                Settings(home=Path("/nowhere")),
                delivery(Address.webhook(server.url + PATH)),
                LETTER.created_at,
            )
        assert [r.path for r in server.requests] == [PATH]
    assert "sesame" not in str(refused.value)


class _Dripping(socketserver.BaseRequestHandler):
    """Answers for ever, a letter at a time."""

    def handle(self) -> None:
        self.request.sendall(b"HTTP/1.1 200 OK\r\nLong: ")
        with suppress(OSError):
            while True:
                self.request.sendall(b"a")
                time.sleep(0.05)


def test_a_webhook_that_never_ends_its_answer_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "_PATIENCE_S", 0.5)
    server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), _Dripping)
    with running(server), pytest.raises(NotDelivered, match=r"did not answer within 0\.5 s"):
        call(f"http://127.0.0.1:{server.server_address[1]}/")


def test_a_name_that_no_host_can_have_is_one_that_does_not_answer() -> None:
    with pytest.raises(NotDelivered, match="https://xn--a cannot be reached"):
        call("https://xn--a/")


def test_neither_a_proxy_nor_a_password_of_the_environment_is_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with webhook() as server, webhook() as proxy:
        monkeypatch.setenv("HTTP_PROXY", proxy.url)
        monkeypatch.setenv("ALL_PROXY", proxy.url)
        monkeypatch.setenv("NO_PROXY", "")
        (tmp_path / "netrc").write_text("default login me password sesame\n")
        monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
        call(server.url)
        assert (len(server.requests), proxy.requests) == (1, [])
        assert "Authorization" not in server.requests[0].headers


def test_a_webhook_whose_certificate_nobody_vouches_for_is_told_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = certificate(tmp_path)
    with webhook() as server:
        server.socket = tls(made).wrap_socket(server.socket, server_side=True)
        url = server.url.replace("http", "https")
        with pytest.raises(NotDelivered, match="CERTIFICATE_VERIFY_FAILED"):
            call(url)
        assert server.requests == []
        monkeypatch.setenv("SSL_CERT_FILE", str(made))
        call(url)
        assert len(server.requests) == 1


def test_a_mail_says_who_what_and_which() -> None:
    server = MailServer()
    with running(server):
        write_to(by_mail(server.port))
    (letter,) = server.letters
    assert letter["To"] == "ops@lab.example"
    assert letter["From"] == "sms@lab.example"
    assert letter["Subject"] == f"[sms] {LETTER.subject}"
    assert letter["Message-ID"] == f"<{LETTER.id}@lab.example>"
    assert letter["Auto-Submitted"] == "auto-generated"
    assert letter.get_content().split("\r\n") == ["- one", "- µ", ""]


def test_a_password_is_given_behind_tls_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = certificate(tmp_path)
    monkeypatch.setenv("SSL_CERT_FILE", str(made))
    known = {"smtp_user": "sms", "smtp_security": "starttls"}
    server = MailServer(made, PASSWORD)
    with running(server):
        write_to(by_mail(server.port, smtp_password=PASSWORD, **known))
        assert len(server.letters) == 1
        with pytest.raises(NotDelivered, match="refused user and password") as refused:
            write_to(by_mail(server.port, smtp_password="sesame-mistyped", **known))
        assert "sesame" not in str(refused.value)  # which the server has repeated
    assert not [line for line in server.in_clear if b"AUTH" in line or b"MAIL" in line]


def test_a_server_without_tls_is_told_nothing_where_it_is_wanted() -> None:
    server = MailServer()
    with running(server), pytest.raises(NotDelivered, match="STARTTLS"):
        write_to(by_mail(server.port, smtp_security="starttls", smtp_user="sms", smtp_password=PASSWORD))
    assert server.letters == []
    assert [line.split()[0] for line in server.in_clear] == [b"ehlo"]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"smtp_host": ""}, "'smtp_host' is empty"),
        ({"smtp_from": ""}, "'smtp_from' is empty"),
        ({"smtp_from": "sms@lab\r\nBcc: all@lab"}, "no address of one mailbox"),
        ({"smtp_user": "sms", "smtp_password": PASSWORD}, "'smtp_security' is none"),
        ({"smtp_user": "sms", "smtp_password": "µ", "smtp_security": "tls"}, "beyond ASCII"),
    ],
)
def test_settings_with_which_no_mail_can_be_sent_are_named(given: dict[str, str], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        write_to(by_mail(9, **given))


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("https://hooks.example/T0/secret", "https://hooks.example/..."),
        ("https://hooks.example:8443/", "https://hooks.example:8443"),
        ("https://hooks.example?token=secret", "https://hooks.example/..."),
        ("http://localhost:8080/x", "http://localhost:8080/..."),
        ("http://[::1]:8080/x", "http://[::1]:8080/..."),
        ("http://127.8.9.1/", "http://127.8.9.1"),
    ],
)
def test_an_address_is_shown_without_what_is_secret(url: str, shown: str) -> None:
    assert Address.webhook(url).shown == shown


@pytest.mark.parametrize(
    "url",
    [
        "http://hooks.example/sesame",
        "http://127.0.0.1.hooks.example/sesame",
        "http://10.0.0.1/sesame",
        "http://localhost@hooks.example/sesame",
        "https://me:sesame@hooks.example/",
        "file:///etc/sesame",
        "gopher://127.0.0.1/sesame",
        "https:///sesame",
        "https://host\\other/sesame",
        "https://[::1%eth0]/sesame",
        "http://127.0.0.1\\@hooks.example/sesame",
        "https://hooks.example/sesame\r\nHost: other",
        "https://hooks.example:port/sesame",
        "https://hooks.example/sesame" + "e" * 2000,
        "",
    ],
)
def test_other_addresses_are_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(InvalidInput) as refused:
        Address.webhook(url)
    assert "sesame" not in str(refused.value)


@pytest.mark.parametrize(
    "address", ["ops", "ops@", "a@b, c@d", "a@b\nBcc: c@d", "-oQ/tmp@b", "A <a@b>", "a@" + "b" * 260]
)
def test_what_is_no_mailbox_is_refused(address: str) -> None:
    with pytest.raises(InvalidInput, match="no address of one mailbox"):
        Address.mail(address)


def test_no_secret_is_told(services: Services, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with webhook(500) as server:
        address = Address.webhook(server.url + PATH)
        shown = notifications.add(services, "night", address, [Topic.JOB_FAILED], SecretStr(SECRET))
        assert shown is not None
        with pytest.raises(NotDelivered) as refused:
            notifications.test(services, "night")
        assert server.requests[0].path == PATH
    listed = [*notifications.subscriptions(services), *notifications.sent(services)]
    with services.catalogue.reading() as session:
        audited = [(row.action, row.arguments) for row in session.scalars(select(AuditRow))]
    assert [action for action, _ in audited] == ["notifications.add", "notifications.test"]
    for told in (caplog.text, str(refused.value), repr(listed), repr(audited), repr(address), repr(shown)):
        assert "sesame" not in told


def test_a_test_says_what_happened_and_is_not_sent_again(services: Services) -> None:
    with webhook(500, 200) as server:
        notifications.add(services, "night", Address.webhook(server.url), [Topic.JOB_FAILED])
        with pytest.raises(NotDelivered, match="answered 500"):
            notifications.test(services, "night")
        assert notifications.test(services, "night") == server.url
        assert [r.told["topic"] for r in server.requests] == ["test", "test"]
    second, first = notifications.sent(services)
    assert (first.state, first.error, second.state) == ("given up", f"{server.url} answered 500", "sent")


def test_what_cannot_be_subscribed_is_refused(services: Services) -> None:
    somewhere = Address.webhook("https://hooks.example/")
    assert notifications.add(services, "night", somewhere, list(Topic)) is not None
    with pytest.raises(Conflict, match="'night' already"):
        notifications.add(services, "night", somewhere, list(Topic))
    with pytest.raises(InvalidInput, match="no topic"):
        notifications.add(services, "day", somewhere, [])
    with pytest.raises(InvalidInput, match="9 letters"):
        notifications.add(services, "day", somewhere, list(Topic), SecretStr("too short"))
    with pytest.raises(ConfigurationError, match="smtp_host"):
        notifications.add(services, "day", Address.mail("ops@lab.example"), list(Topic))
    with pytest.raises(NotFound, match="'day'"):
        notifications.test(services, "day")
    with pytest.raises(NotFound, match="'day'"):
        notifications.remove(services, "day")


def test_only_an_administrator_changes_who_is_told(services: Services) -> None:
    somewhere = Address.webhook("https://hooks.example/")
    notifications.add(services, "night", somewhere, list(Topic))
    metrologist = services.acting(Actor("ada", Role.METROLOGIST, "web", "here", confirmed=True))
    with pytest.raises(NotAllowed):
        notifications.add(metrologist, "day", somewhere, list(Topic))
    with pytest.raises(NotAllowed):
        notifications.test(metrologist, "night")
    with pytest.raises(NotAllowed):
        notifications.remove(metrologist, "night")
    viewer = services.acting(Actor("bob", Role.VIEWER, "web", "here"))
    assert [s.name for s in notifications.subscriptions(viewer)] == ["night"]
    assert notifications.sent(viewer) == []


@contextmanager
def mailing(home: Path) -> Iterator[MailServer]:
    """Run a mail server that the settings of a home name."""
    server = MailServer()
    (home / "sms.toml").write_text(
        f'smtp_host = "127.0.0.1"\nsmtp_port = {server.port}\nsmtp_from = "sms@lab.example"\n'
        'smtp_security = "none"\n'
    )
    with running(server):
        yield server


def test_the_commands_subscribe_test_show_and_remove(home: Path) -> None:
    bootstrap.initialise(home)
    at = ["--home", str(home)]
    with mailing(home) as server:
        added = inside(
            "notify", "add", "night", "--mail", "ops@lab.example", "--on", "job-failed,queue-done", *at
        )
        assert (added.returncode, added.stdout) == (0, "")
        tested = inside("notify", "test", "night", *at)
        assert (tested.returncode, tested.stderr) == (0, "ops@lab.example has taken it\n")
        assert server.letters[0]["Subject"] == "[sms] a test of the subscription night"
    down = inside("notify", "test", "night", *at)
    assert down.returncode == 7
    assert "did not take it" in down.stderr
    (listed,) = answer("notify", "list", *at)
    assert (listed["name"], listed["topics"]) == ("night", ["job-failed", "queue-done"])
    assert [s["state"] for s in answer("notify", "sent", *at)] == ["given up", "sent"]
    assert inside("notify", "remove", "night", *at).returncode == 0
    assert answer("notify", "list", *at) == []


def test_the_secret_of_a_webhook_is_shown_once(home: Path) -> None:
    bootstrap.initialise(home)
    at = ["--home", str(home)]
    added = answer("notify", "add", "ci", "--webhook", "https://hooks.example/T0", *at)
    assert (len(added["secret"]), added["where"]) == (43, "https://hooks.example/...")
    shown = inside("notify", "list", *at).stdout + inside("notify", "list", "--json", *at).stdout
    assert "ci" in shown
    assert added["secret"] not in shown
    wrong = inside("notify", "add", "day", "--webhook", "https://hooks.example/T0", "--on", "nothing", *at)
    assert (wrong.returncode, "no topic 'nothing'" in wrong.stderr) == (2, True)
    both = inside("notify", "add", "day", "--webhook", "https://h.example", "--mail", "a@b.example", *at)
    assert both.returncode == 2
