"""The door of a scanner's server: it lets in who proves to know the key, whoever else stands there.

All callers are looked after side by side, by one thread that never waits for any of them. Who has not
proven itself in time is sent away, and so is the one that has stood there longest when there are too many.
"""

from __future__ import annotations

import logging
import secrets
import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from sms_jobs.instruments.scanners.link import Address
from sms_jobs.instruments.scanners.proof import (
    HELLO_BYTES,
    NONCE_BYTES,
    PROOF_BYTES,
    PROTOCOL,
    SessionKeys,
    client_proof,
    hello,
    protocol_of,
    same,
    server_proof,
    session_keys,
)

PROOF_S = 5.0
"""What a caller may take to prove that it has the key."""
MOST_CALLERS = 128
"""That have not proven themselves; well below the number of files that a program may have open."""
_BACKLOG = 1024

logger = logging.getLogger(__name__)

LetIn = Callable[[socket.socket, SessionKeys, str], None]
"""Is given the wire of a client that has proven itself, the keys, and its address."""


@dataclass
class _Caller:
    """One that stands at the door."""

    number: int
    wire: socket.socket
    address: str
    since: float
    said: bytearray = field(default_factory=bytearray)
    greeting: bytes = b""
    """What the server said; empty until the caller has."""


class Door:
    """Listens, and hands on who has the key.

    Parameters
    ----------
    address
        Where it listens; port 0 takes a free one, see `address`.
    key
        What a client has to know.
    let_in
        Called by the thread of the door, which it must not keep waiting.
    """

    def __init__(self, address: Address, key: bytes, let_in: LetIn) -> None:
        self._key = key
        self._let_in = let_in
        self._listener = socket.create_server((address.host, address.port), backlog=_BACKLOG)
        self._listener.setblocking(False)
        host, port = self._listener.getsockname()[:2]
        self.address = Address(str(host), int(port))
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._knob, self._inside = socket.socketpair()
        self._selector.register(self._knob, selectors.EVENT_READ)
        self._count = 0
        # In the order in which they came.
        self._callers: dict[int, _Caller] = {}
        self._thread = threading.Thread(target=self._watch, name="link-door", daemon=True)

    def open(self) -> None:
        """Begin to let clients in."""
        self._thread.start()

    def close(self) -> None:
        """Send everybody away who stands there, and listen no more."""
        self._inside.close()
        if self._thread.ident is not None:
            self._thread.join()

    def _watch(self) -> None:
        try:
            while True:
                for found, _ in self._selector.select(self._until_next()):
                    if found.fileobj is self._knob:
                        return
                    if found.fileobj is self._listener:
                        self._receive_caller()
                    elif found.data in self._callers:  # or it has just been sent away
                        self._attend(self._callers[found.data])
                self._send_away_the_slow()
        finally:
            for caller in tuple(self._callers.values()):
                self._send_away(caller, "the server ends")
            for one in (self._selector, self._listener, self._knob):
                one.close()

    def _until_next(self) -> float | None:
        """Return the time until the first of the callers is sent away."""
        first = next(iter(self._callers.values()), None)
        return None if first is None else max(0.0, first.since + PROOF_S - time.monotonic())

    def _receive_caller(self) -> None:
        try:
            wire, address = self._listener.accept()
        except OSError as error:  # it has gone again, or this program has too many files open
            logger.debug("a caller could not be received: %s", error)
            if self._callers:
                self._send_away(next(iter(self._callers.values())), "room is made for others")
            return
        wire.setblocking(False)
        self._count += 1
        self._callers[self._count] = _Caller(
            self._count, wire, f"{address[0]}:{address[1]}", time.monotonic()
        )
        self._selector.register(wire, selectors.EVENT_READ, self._count)
        if len(self._callers) > MOST_CALLERS:
            self._send_away(next(iter(self._callers.values())), "room is made for others")

    def _attend(self, caller: _Caller) -> None:
        """Take what a caller says, and answer or let it in when it has said all."""
        expected = PROOF_BYTES if caller.greeting else HELLO_BYTES
        try:
            said = caller.wire.recv(expected - len(caller.said))
            caller.said += said
            if not said:
                self._send_away(caller, "it closed the connection")
            elif len(caller.said) == expected and caller.greeting:
                self._judge(caller)
            elif len(caller.said) == expected:
                self._greet(caller)
        except BlockingIOError:  # there was nothing after all
            return
        except OSError as error:
            self._send_away(caller, str(error))

    def _greet(self, caller: _Caller) -> None:
        """Say hello too, with the proof that the key is known here; others than clients learn nothing."""
        ours = hello(secrets.token_bytes(NONCE_BYTES))
        theirs = bytes(caller.said)
        spoken = protocol_of(theirs)
        if spoken is None:
            self._send_away(caller, "it is no client")
            return
        # So little fits in any connection at once. A client of another version learns which this one is.
        caller.wire.send(ours + server_proof(self._key, theirs, ours))
        if spoken != PROTOCOL:
            self._send_away(caller, f"it speaks version {spoken} of the protocol, not {PROTOCOL}")
            return
        caller.greeting = theirs + ours
        caller.said.clear()

    def _judge(self, caller: _Caller) -> None:
        theirs, ours = caller.greeting[:HELLO_BYTES], caller.greeting[HELLO_BYTES:]
        if not same(bytes(caller.said), client_proof(self._key, theirs, ours)):
            self._send_away(caller, "it has another key")
            return
        self._forget(caller)
        caller.wire.setblocking(True)
        self._let_in(caller.wire, session_keys(self._key, theirs, ours), caller.address)

    def _send_away_the_slow(self) -> None:
        latest = time.monotonic() - PROOF_S
        for caller in tuple(self._callers.values()):
            if caller.since > latest:
                return
            self._send_away(caller, f"it did not prove itself within {PROOF_S:g} s")

    def _send_away(self, caller: _Caller, why: str) -> None:
        logger.debug("a caller from %s was turned away: %s", caller.address, why)
        self._forget(caller)
        with suppress(OSError):
            caller.wire.close()

    def _forget(self, caller: _Caller) -> None:
        del self._callers[caller.number]
        self._selector.unregister(caller.wire)
