"""Requests that trickle in: they keep nobody else waiting, and do not last."""

from __future__ import annotations

import selectors
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

import httpx2
import pytest
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.web.connections import HEAD_WITHIN_S

CONNECTIONS = 200
WITHIN_S = 5.0
"""A request takes milliseconds; one that waits for the trickling ones, all of `HEAD_WITHIN_S`."""
LATE_S = 5.0
"""After the time that a head has: that of opening 200 connections, and a machine that does other things."""
HEAD = b"GET /api/v1 HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Long: " + b"a" * 1000


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a console."""
    home = tmp_path_factory.mktemp("slow") / "home"
    bootstrap.initialise(home)
    with serving(home) as address:
        yield address


def connected(site: str) -> socket.socket:
    place = urlsplit(site)
    return socket.create_connection((place.hostname, place.port), timeout=30.0)


def said_until_closed(slow: socket.socket) -> bytes:
    """Return what a server says before it hangs up."""
    said = b""
    while part := slow.recv(4096):
        said += part
    return said


def test_connections_that_trickle_leave_service_to_others_and_are_closed(site: str) -> None:
    longest, ends, began = 0.0, [], time.monotonic()
    with ExitStack() as stack, selectors.DefaultSelector() as open_ones:
        listener = stack.enter_context(connected(site))
        listener.sendall(b"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert listener.recv(4096).startswith(b"HTTP/1.1 200 ")
        for _ in range(CONNECTIONS):
            one = stack.enter_context(connected(site))
            one.sendall(HEAD[:1])
            open_ones.register(one, selectors.EVENT_READ)
        for place in range(1, len(HEAD)):
            for key in list(open_ones.get_map().values()):
                with suppress(OSError):  # it was closed a moment ago, and is found below
                    key.fileobj.send(HEAD[place : place + 1])  # type: ignore[union-attr]
            asked = time.monotonic()
            assert httpx2.get(f"{site}/api/v1").is_success
            assert httpx2.get(f"{site}/api/v1/status").is_success
            longest = max(longest, (time.monotonic() - asked) / 2)
            tick = time.monotonic() + 1.0
            while open_ones.get_map() and (left := tick - time.monotonic()) > 0:
                for key, _ in open_ones.select(left):
                    open_ones.unregister(key.fileobj)
                    ends.append(time.monotonic() - began)
            if not open_ones.get_map():
                break
            assert time.monotonic() - began < HEAD_WITHIN_S + 10.0, "connections stay open"
        assert longest < WITHIN_S
        assert len(ends) == CONNECTIONS
        assert min(ends) > HEAD_WITHIN_S - LATE_S
        assert max(ends) < HEAD_WITHIN_S + LATE_S
        # A request that was whole in time goes on, however long its answer takes.
        listener.setblocking(False)
        with suppress(BlockingIOError):  # nothing to tell, and open
            assert listener.recv(4096) != b""


def test_who_sends_a_head_too_slowly_is_told_and_who_only_connects_is_not(site: str) -> None:
    with connected(site) as silent, connected(site) as slow, connected(site) as second:
        slow.sendall(HEAD[:40])
        # The first request of a connection is answered; its second one trickles.
        second.sendall(b"GET /api/v1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /api")
        assert said_until_closed(slow).startswith(b"HTTP/1.1 408 ")
        assert said_until_closed(silent) == b""
        second.sendall(b"/v1 HT")
        said = said_until_closed(second)
    assert said.startswith(b"HTTP/1.1 200 ")
    assert b"HTTP/1.1 408 " in said
