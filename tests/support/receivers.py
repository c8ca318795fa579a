"""Real servers in the process of a test that take what people are told: by HTTP, and by SMTP."""

from __future__ import annotations

import base64
import json
import socket
import socketserver
import ssl
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from email import message_from_bytes, policy
from email.message import EmailMessage
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Request:
    """What a webhook was sent."""

    path: str
    headers: dict[str, str]
    body: bytes

    @property
    def told(self) -> dict[str, Any]:
        """Its body."""
        found: dict[str, Any] = json.loads(self.body)
        return found


class WebhookServer(ThreadingHTTPServer):
    """Answers each request with the next of some statuses, and the last of them for ever."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, *statuses: int) -> None:
        super().__init__(("127.0.0.1", 0), _Webhook)
        self.statuses = list(statuses or (200,))
        self.requests: list[Request] = []
        self.answering = threading.Event()
        self.answering.set()
        self.url = f"http://127.0.0.1:{self.server_port}"


class _Webhook(BaseHTTPRequestHandler):
    server: WebhookServer

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.requests.append(Request(self.path, dict(self.headers), body))
        self.server.answering.wait(60.0)
        statuses = self.server.statuses
        self.send_response(statuses.pop(0) if len(statuses) > 1 else statuses[0])
        self.send_header("Location", "/elsewhere")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - named by the base class
        pass


class MailServer(socketserver.ThreadingTCPServer):
    """Takes mail as RFC 5321 has it; with a certificate it offers STARTTLS, and passwords behind that."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, certificate: Path | None = None, password: str = "") -> None:
        super().__init__(("127.0.0.1", 0), _Mail)
        self.context = None if certificate is None else tls(certificate)
        self.password = password
        self.letters: list[EmailMessage] = []
        self.in_clear: list[bytes] = []
        self.port = int(self.server_address[1])


class _Mail(socketserver.BaseRequestHandler):
    server: MailServer

    def setup(self) -> None:
        self.connection: socket.socket = self.request
        self.file = self.connection.makefile("rb")
        self.is_safe = False

    def finish(self) -> None:
        self.file.close()
        self.connection.close()

    def say(self, *lines: str) -> None:
        for number, line in enumerate(lines):
            between = " " if number == len(lines) - 1 else "-"
            self.connection.sendall(f"{line[:3]}{between}{line[4:]}\r\n".encode())

    def handle(self) -> None:
        self.say("220 here")
        while line := self.file.readline():
            if not self.is_safe:
                self.server.in_clear.append(line)
            word = line.split()[0].upper().decode() if line.split() else ""
            if word == "QUIT":
                self.say("221 bye")
                return
            self.answer(word, line.strip())

    def answer(self, word: str, line: bytes) -> None:
        if word == "EHLO":
            offered = ["250 AUTH PLAIN"] if self.is_safe else ["250 STARTTLS"] if self.server.context else []
            self.say("250 here", *offered)
        elif word == "STARTTLS" and self.server.context is not None:
            self.say("220 go ahead")
            self.file.close()
            self.connection = self.server.context.wrap_socket(self.connection, server_side=True)
            self.file = self.connection.makefile("rb")
            self.is_safe = True
        elif word == "AUTH":
            given = base64.b64decode(line.split()[2]).split(b"\0")[2].decode()
            self.say("235 welcome" if given == self.server.password else f"535 no, not {given}")
        elif word == "DATA":
            self.say("354 go ahead")
            letter = b""
            while (more := self.file.readline()) != b".\r\n":
                letter += more.removeprefix(b".") if more.startswith(b"..") else more
            parsed = message_from_bytes(letter, policy=policy.default)
            assert isinstance(parsed, EmailMessage)
            self.server.letters.append(parsed)
            self.say("250 taken")
        else:
            self.say("250 fine" if word in ("MAIL", "RCPT", "RSET", "NOOP") else "502 what")


@contextmanager
def running(server: socketserver.BaseServer) -> Iterator[None]:
    """Let a server answer meanwhile."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join(timeout=10.0)


@contextmanager
def webhook(*statuses: int) -> Iterator[WebhookServer]:
    """Run a web server that answers so."""
    server = WebhookServer(*statuses)
    with running(server):
        yield server


def tls(certificate: Path) -> ssl.SSLContext:
    """Return what a server with a certificate speaks."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate)
    return context


def certificate(folder: Path) -> Path:
    """Make a certificate of this host with its key, in one file."""
    made = folder / "certificate.pem"
    key = folder / "key.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes"]
    command += ["-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2"]
    subprocess.run([*command, "-keyout", key, "-out", made], check=True, capture_output=True)
    made.write_text(made.read_text() + key.read_text())
    return made
