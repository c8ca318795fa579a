"""`sms serve`: the console and the interface over HTTP."""

from __future__ import annotations

import os
import socket
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.cli import output
from sms_jobs.cli.commands import loading
from sms_jobs.cli.output import Home
from sms_jobs.errors import Conflict, InvalidInput

if TYPE_CHECKING:
    import uvicorn

HERE = "127.0.0.1:8470"
"""Where the console is unless told otherwise."""
_LOOPBACK = ("127.0.0.1", "localhost", "::1")


def serve(
    listen: Annotated[
        str, typer.Option(help="Address and port; another address than this machine's own needs TLS.")
    ] = HERE,
    tls_certificate: Annotated[Path | None, typer.Option(help="Certificate chain (PEM).")] = None,
    tls_key: Annotated[Path | None, typer.Option(help="Private key of the certificate (PEM).")] = None,
    behind_proxy: Annotated[
        bool, typer.Option("--behind-proxy", help="A proxy before it has the TLS, and says who asks.")
    ] = False,
    host_name: Annotated[
        list[str] | None, typer.Option(help="Name by which browsers ask for it; may be repeated.")
    ] = None,
    until_eof: Annotated[
        bool, typer.Option("--until-eof", hidden=True, help="End when stdin ends, as when its parent dies.")
    ] = False,
    home: Home = None,
) -> None:
    """Serve the console to browsers and the interface /api/v1 to programs, until Ctrl-C.

    Example: sms serve; then open http://127.0.0.1:8470
    """
    # Which takes a second; no other command needs it.
    with loading():
        from sms_jobs.web import memory
        from sms_jobs.web.application import application
        from sms_jobs.web.connections import PromptServer
        from sms_jobs.web.protection import Options

    address, port = _place(listen)
    local = address in _LOOPBACK
    if (tls_certificate is None) != (tls_key is None):
        raise InvalidInput("TLS takes --tls-certificate and --tls-key; give both")
    if not local and tls_certificate is None and not behind_proxy:
        raise InvalidInput(
            f"{address} can be reached from other machines: give --tls-certificate and --tls-key, or "
            "--behind-proxy where a proxy before it has the TLS"
        )
    _require_free(address, port)
    secure = tls_certificate is not None or behind_proxy
    hosts = frozenset((*(host_name or ()), *_LOOPBACK, address)) if local or host_name else frozenset()
    output.log_to_stderr()
    with bootstrap.services(home, "web") as services:
        memory.share(services)
        if not (local and not behind_proxy) and not people.has_people(services):
            raise InvalidInput(
                "nobody has a name here, so that everybody on the network could do everything; "
                "'sms person add' gives the first"
            )
        with loading():
            app = application(services, Options(hosts, secure, desk=local and not behind_proxy))
        scheme = "https" if tls_certificate is not None else "http"
        output.say(f"serving {services.settings.home} at {scheme}://{listen}; Ctrl-C ends it")
        server = PromptServer(
            app,
            app.state.follower.dismiss,
            host=address,
            port=port,
            ssl_certfile=tls_certificate,
            ssl_keyfile=tls_key,
            proxy_headers=behind_proxy,
        )
        if until_eof:
            threading.Thread(target=_end_with_stdin, args=(server,), name="stdin", daemon=True).start()
        server.run()


def _end_with_stdin(server: uvicorn.Server) -> None:
    while os.read(0, 1024):
        pass
    server.should_exit = True


def _require_free(address: str, port: int) -> None:
    """Raise `Conflict` where nothing can listen, before anybody is told that something does."""
    try:
        family, kind, _, _, place = socket.getaddrinfo(address, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            tried.bind(place)
            tried.listen()
    except OSError as error:
        raise Conflict(
            f"nothing can listen on {address}, port {port}: {error.strerror}; stop what serves there, or "
            "choose another with --listen"
        ) from error


def require_here(listen: str) -> None:
    """Raise `InvalidInput` for what is no address and port, or can be reached from other machines."""
    address, _ = _place(listen)
    if address not in _LOOPBACK:
        raise InvalidInput(
            f"{address} can be reached from other machines: 'sms serve' serves the console there, with "
            "--tls-certificate and --tls-key, or --behind-proxy"
        )


def _place(listen: str) -> tuple[str, int]:
    address, _, port = listen.rpartition(":")
    if not address or not port.isdecimal() or not 0 <= int(port) < 65536:
        raise InvalidInput(f"'{listen}' is no address and port; write it as 127.0.0.1:8470")
    return address.strip("[]"), int(port)
