"""The link to a scanner among strangers: who relays, repeats, changes or says nothing achieves nothing."""

from __future__ import annotations

import logging
import resource
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress

import pytest
from support.command import wait_until

from sms_jobs.errors import FrameLost, LinkLost
from sms_jobs.formats.rig_configuration import parse_rig
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.scanners.link import Address, ScannerLink
from sms_jobs.instruments.scanners.proof import CHALLENGE_BYTES, HELLO_BYTES, PROOF_BYTES, hello
from sms_jobs.instruments.scanners.server import ScannerServer
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.jobs.devices.stations import known_sensors
from sms_jobs.virtual_rig.campaigns import small_plate

KEY = bytes(range(32))
RIG = """
name = "scanner"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [{ name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 }]
"""
SILENCE_S = 2.0
"""Long enough for a busy machine, short enough to be waited for."""


@pytest.fixture
def server() -> Iterator[ScannerServer]:
    rig = parse_rig(RIG, "scanner.toml", known_sensors())
    made = ScannerServer(lambda: rig, Address("127.0.0.1", 0), KEY, silence_s=SILENCE_S)
    thread = threading.Thread(target=made.serve)
    thread.start()
    yield made
    made.stop()
    thread.join()


def client(address: Address, key: bytes = KEY) -> ScannerLink:
    scene = small_plate("plate")[1].scene
    assert scene is not None
    return ScannerLink(address, key, RealClock(), Setting(scene, "S00", ()), SILENCE_S)


def is_served(address: Address) -> None:
    with closing(client(address)) as link:
        assert set(link.facts["cameras"]) == {"C1"}


def ask_until_it_ends(link: ScannerLink) -> None:
    """Ask on and on; a sign of life, which is no answer, may be the first that is changed."""
    while True:
        link.ask("time")


def stranger(server: ScannerServer) -> socket.socket:
    return socket.create_connection((server.address.host, server.address.port), 10.0)


def said_until_the_end(wire: socket.socket, first: int = 0) -> bytes:
    """Return what an end says before it hangs up, or its first bytes."""
    said = b""
    with suppress(ConnectionResetError):
        while not first or len(said) < first:
            got = wire.recv(1 << 16)
            if not got:
                break
            said += got
    return said


Change = Callable[[bytes], bytes]


def as_it_is(data: bytes) -> bytes:
    return data


class Relay:
    """Stands between a client and the server, and does what it likes with what they say after their proofs.

    Attributes
    ----------
    from_client, from_server
        Return what is passed on in the place of some bytes.
    black_hole
        Once set, nothing passes and nobody is told: as when the power is gone.
    heard
        All that the client said.
    """

    def __init__(self, server: Address) -> None:
        self.from_client: Change = as_it_is
        self.from_server: Change = as_it_is
        self.black_hole = threading.Event()
        self.heard = b""
        self._server = server
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = Address("127.0.0.1", self._listener.getsockname()[1])
        self._wires: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for wire in self._wires:
            with suppress(OSError):
                wire.shutdown(socket.SHUT_RDWR)
            wire.close()

    def _serve(self) -> None:
        with suppress(OSError):
            there, _ = self._listener.accept()
            here = socket.create_connection((self._server.host, self._server.port))
            self._wires += [there, here]
            for source, target, untouched, ours in (
                (there, here, HELLO_BYTES + PROOF_BYTES, True),
                (here, there, CHALLENGE_BYTES, False),
            ):
                threading.Thread(
                    target=self._pump, args=(source, target, untouched, ours), daemon=True
                ).start()

    def _pump(self, source: socket.socket, target: socket.socket, untouched: int, ours: bool) -> None:
        with suppress(OSError):
            while data := source.recv(untouched or 1 << 16):
                if ours:
                    self.heard += data
                if self.black_hole.is_set():
                    continue
                if untouched:
                    untouched -= len(data)
                else:
                    data = (self.from_client if ours else self.from_server)(data)
                target.sendall(data)
            if not self.black_hole.is_set():
                target.shutdown(socket.SHUT_WR)


@contextmanager
def relay(server: ScannerServer) -> Iterator[Relay]:
    made = Relay(server.address)
    try:
        yield made
    finally:
        made.close()


@contextmanager
def impostor(answer: Change) -> Iterator[tuple[Address, list[bytes]]]:
    """Listen in the place of a server, answer the first words of each caller, and note what it says."""
    heard: list[bytes] = []

    def serve(listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                wire, _ = listener.accept()
                with wire:
                    said = said_until_the_end(wire, HELLO_BYTES)
                    wire.sendall(answer(said))
                    heard.append(said + said_until_the_end(wire))

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        try:
            yield Address("127.0.0.1", listener.getsockname()[1]), heard
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.parametrize(
    "answer",
    [
        lambda said: said + said[:PROOF_BYTES],  # its own words, sent back
        lambda _: hello(bytes(32)) + bytes(PROOF_BYTES),
    ],
    ids=["reflection", "guess"],
)
def test_a_client_says_nothing_to_who_has_not_the_key(answer: Change) -> None:
    with impostor(answer) as (address, heard):
        with pytest.raises(LinkLost, match="has another key"):
            client(address)
        wait_until(lambda: heard)
    assert len(heard[0]) == HELLO_BYTES  # no proof that could be passed on, and no request


def test_a_client_tells_what_listens_in_the_place_of_a_server() -> None:
    other = struct.pack("!8sI", b"sms-link", 7)
    for said, told in (
        (other, "speaks version 7 of the protocol and this computer version 3"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "is no server of a scanner"),
    ):
        answer = said.ljust(CHALLENGE_BYTES, b"\0")
        with impostor(lambda _, answer=answer: answer) as (address, _), pytest.raises(LinkLost, match=told):
            client(address)


def test_the_server_lets_nobody_in_who_has_not_the_key(server: ScannerServer) -> None:
    with pytest.raises(LinkLost, match="has another key"):
        client(server.address, bytes(32))
    with stranger(server) as wire:
        wire.sendall(hello(bytes(32)))
        challenge = said_until_the_end(wire, CHALLENGE_BYTES)
        wire.sendall(challenge[HELLO_BYTES:])  # its own proof, sent back
        assert said_until_the_end(wire) == b""
    with stranger(server) as wire:
        wire.sendall(b"GET / HTTP/1.1\r\nHost: scanner\r\nConnection: close\r\n\r\n")
        assert said_until_the_end(wire) == b""
    is_served(server.address)


def test_a_session_cannot_be_played_again(server: ScannerServer) -> None:
    with relay(server) as between:
        is_served(between.address)
    with stranger(server) as wire:
        wire.sendall(between.heard)
        said = said_until_the_end(wire)
    assert len(said) <= CHALLENGE_BYTES  # nothing but what any caller is told


def flipped(place: int) -> Change:
    def change(data: bytes) -> bytes:
        at = place % len(data)
        return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]

    return change


@pytest.mark.parametrize(
    "change",
    [
        flipped(0),  # what it is
        flipped(8),  # how long
        flipped(20),  # the tag of that
        flipped(60),  # the text
        flipped(-1),  # the last tag
        lambda data: data + data,
    ],
    ids=["kind", "length", "tag", "text", "end", "twice"],
)
def test_what_is_changed_on_its_way_ends_the_link(server: ScannerServer, change: Change) -> None:
    with relay(server) as between, closing(client(between.address)) as link:
        between.from_server = change
        with pytest.raises(LinkLost, match="was changed on its way"):
            ask_until_it_ends(link)
        with pytest.raises(LinkLost, match="was changed on its way"):  # and so it stays
            link.ask("time")
    with relay(server) as between, closing(client(between.address)) as link:
        between.from_client = change
        with pytest.raises(LinkLost, match=r"closed the connection|reset|Broken pipe"):
            ask_until_it_ends(link)
    is_served(server.address)


def test_what_an_end_said_cannot_be_sent_back_to_it(server: ScannerServer) -> None:
    with relay(server) as between, closing(client(between.address)) as link:
        said: list[bytes] = []

        def keep(data: bytes) -> bytes:
            said.append(data)
            return data

        between.from_client = keep
        link.ask("time")
        between.from_server = lambda _: said[-1]
        with pytest.raises(LinkLost, match="was changed on its way"):
            ask_until_it_ends(link)


def test_strangers_that_say_nothing_keep_nobody_out(server: ScannerServer) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
    try:
        with ExitStack() as strangers:
            for number in range(1000):
                wire = strangers.enter_context(stranger(server))
                if number % 2:  # some begin and do not go on
                    with suppress(OSError):
                        wire.sendall(hello(bytes(32))[: number % HELLO_BYTES])
            began = time.monotonic()
            is_served(server.address)
            # Without waiting for any of them, who have 5 s; in 0.1 s where nothing else runs.
            assert time.monotonic() - began < 5.0
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_server_that_stops_in_the_middle_of_its_proof_is_given_up() -> None:
    with (
        impostor(lambda said: said[:20]) as (address, _),
        pytest.raises(LinkLost, match="did not prove within 5 s that it knows the key"),
    ):
        client(address)


def test_a_server_that_stops_in_the_middle_of_a_message_is_given_up(server: ScannerServer) -> None:
    with relay(server) as between, closing(client(between.address)) as link:

        def cut(data: bytes) -> bytes:
            between.black_hole.set()
            return data[: len(data) // 2]

        between.from_server = cut
        with pytest.raises(LinkLost, match="no sign of life for 2 s"):
            link.ask("time", 60.0)


def test_a_scanner_is_free_and_dark_when_its_client_has_lost_its_power(
    server: ScannerServer, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with relay(server) as between, closing(client(between.address)) as link:
        link.ask("show", projector="P1", number=-1)
        between.black_hole.set()
        wait_until(lambda: "projectors are dark" in caplog.text)
        assert "has gone (no sign of life for 2 s)" in wait_until(
            lambda: caplog.text if "has gone" in caplog.text else ""
        )
        is_served(server.address)


def test_who_works_or_waits_for_long_is_not_given_up(server: ScannerServer) -> None:
    with closing(client(server.address)) as link:
        began = time.monotonic()
        link.ask("arm", camera="C1", exposure=1.0)
        while time.monotonic() - began < 2 * SILENCE_S:
            with pytest.raises(FrameLost):
                link.ask("read", camera="C1", timeout_s=1.5 * SILENCE_S)
        assert link.ask("time")[0]["time_s"] > 0.0
