"""`sms metrics`: what a monitoring system reads over HTTP."""

from __future__ import annotations

import ipaddress
import socket
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Annotated

import typer
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from sms_jobs import bootstrap
from sms_jobs.app.home import service
from sms_jobs.bootstrap import Services
from sms_jobs.cli import output
from sms_jobs.cli.output import Home
from sms_jobs.errors import ConfigurationError, Conflict

_PATIENCE_S = 10.0
"""How long a client may take to say what it wants."""


def metrics(
    port: Annotated[int, typer.Option(help="Where to listen; 0 for any free port.", min=0, max=65535)] = 9464,
    address: Annotated[
        str, typer.Option(help="Address to listen on; nobody needs a password, so mind who can reach it.")
    ] = "127.0.0.1",
    once: Annotated[bool, typer.Option("--once", help="Print the numbers and end.")] = False,
    home: Home = None,
) -> None:
    """Serve numbers about jobs, queues, workers, archive and schedules to Prometheus, until Ctrl-C.

    Example: sms metrics --port 9464
    """
    with bootstrap.services(home) as services:
        if once:
            output.print_text(service.metrics(services))
            return
        server = _Server(services, address, port)
        host, listening = server.server_address[:2]
        output.say(f"metrics at http://{_shown(str(host))}:{listening}/metrics; Ctrl-C ends it")
        try:
            server.serve_forever()
        finally:
            server.server_close()


def _shown(host: str) -> str:
    return f"[{host}]" if ":" in host else host


class _Server(ThreadingHTTPServer):
    """Listens on one address and gives its requests the services."""

    daemon_threads = True

    def __init__(self, services: Services, address: str, port: int) -> None:
        try:
            version = ipaddress.ip_address(address).version
        except ValueError as error:
            raise ConfigurationError(
                f"'{address}' is not an address; write one like 127.0.0.1 or ::1"
            ) from error
        self.services = services
        self.address_family = socket.AF_INET6 if version == 6 else socket.AF_INET
        try:
            super().__init__((address, port), _Handler)
        except OSError as error:
            raise Conflict(
                f"nothing can listen on {address}, port {port}: {error.strerror}; choose another with --port"
            ) from error


class _Handler(BaseHTTPRequestHandler):
    """Answers `GET /metrics` and nothing else."""

    server: _Server
    server_version = "sms"
    sys_version = ""
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        """Answer a request."""
        if self.path.partition("?")[0] != "/metrics":
            self.send_error(HTTPStatus.NOT_FOUND, "only /metrics is here")
            return
        body = service.metrics(self.server.services).encode()
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", CONTENT_TYPE_PLAIN_0_0_4)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - named by the base class
        """Say nothing of each request."""
