"""The connection between the server of a scanner and its client, and the client's end of it.

Messages are JSON, an image follows as bytes: nothing that is received is ever executed. Both ends prove
that they know one key before anything else is said. Every request is answered, in order.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, answer_challenge, deliver_challenge
from socket import AF_INET, IPPROTO_TCP, SOCK_STREAM, TCP_NODELAY, create_connection, fromfd, socket
from typing import Any

from pydantic import TypeAdapter

from sms_jobs import errors
from sms_jobs.errors import DeviceFault, InvalidInput, LinkLost, SmsError
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import Deformation

PROTOCOL = 1
SETTING = TypeAdapter(Setting)
SEQUENCE = TypeAdapter(FringeSequence)
DEFORMATION = TypeAdapter(tuple[Deformation, ...])
LONGEST_MESSAGE = 1 << 30
"""In bytes: a frame of 500 megapixels."""

_CONNECT_S = 5.0
_ANSWER_S = 15.0
"""What a server may take for anything but waiting for a frame; real cameras are slow to open."""
_RENDERED_S = 120.0
"""The least that a simulated scanner is waited for: light is computed, the first time after compiling."""
_PINGS = 5


@dataclass(frozen=True)
class Address:
    """Where a server listens."""

    host: str
    port: int

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read `host:port`; raise `InvalidInput` for anything else."""
        host, colon, port = text.rpartition(":")
        if not colon or not host or not port.isdecimal() or not 0 <= int(port) <= 65535:
            raise InvalidInput(f"'{text}' is no address of a server: write it like 192.168.7.11:7411")
        return cls(host, int(port))

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class ScannerLink:
    """The client's end: it asks one thing after the other, and may leave answers for later.

    Attributes
    ----------
    facts
        What the server said of its sensors: `cameras` and `projectors` by name, and whether they are
        `simulated`.
    behind_s
        What has to be added to the server's times to have the client's.
    """

    def __init__(self, address: Address, key: bytes, clock: Clock, setting: Setting | None) -> None:
        """Connect and have the server connect its instruments.

        Raises
        ------
        LinkLost
            There is no server, or it has another key.
        InstrumentError
            One of its instruments does not answer.
        """
        self._address = address
        self._clock = clock
        self._owed = 0
        self._lost = False
        self._least_patience_s = 0.0
        self._connection = _connection(address, key)
        try:
            told = None if setting is None else SETTING.dump_python(setting, mode="json")
            self.facts = self.ask("open", protocol=PROTOCOL, setting=told)[0]
            self._least_patience_s = _RENDERED_S if self.simulated else 0.0
            self.behind_s = self._behind()
        except BaseException:
            self.close()
            raise

    @property
    def simulated(self) -> bool:
        """Whether its sensors are made of light rays."""
        return bool(self.facts["simulated"])

    def tell(self, command: str, **values: Any) -> None:
        """Send a request without waiting for its answer; what goes wrong is raised by the next `ask`."""
        self._send(command, values)
        self._owed += 1

    def ask(
        self, command: str, patience_s: float = _ANSWER_S, **values: Any
    ) -> tuple[Mapping[str, Any], bytes]:
        """Send a request and return its answer, with the bytes that follow it.

        Raises
        ------
        LinkLost
            The server does not answer.
        SmsError
            What it has to report, of this request or of one before.
        """
        self._send(command, values)
        failure: SmsError | None = None
        answer: tuple[Mapping[str, Any], bytes] = ({}, b"")
        for _ in range(self._owed + 1):
            answer = self._answer(max(patience_s, self._least_patience_s))
            if failure is None and "error" in answer[0]:
                failure = _as_error(answer[0])
        self._owed = 0
        if failure is not None:
            raise failure
        return answer

    def close(self) -> None:
        """Let go of the server, which then leaves its instruments dark and still."""
        self._lost = True
        self._connection.close()

    def _behind(self) -> float:
        """Return how far the server's clock is behind, by the quickest of a few questions."""
        found = []
        for _ in range(_PINGS):
            asked = self._clock.monotonic()
            there = float(self.ask("time")[0]["time_s"])
            answered = self._clock.monotonic()
            found.append((answered - asked, 0.5 * (asked + answered) - there))
        return min(found)[1]

    def _send(self, command: str, values: Mapping[str, Any]) -> None:
        if self._lost:
            raise self._gone("the link was lost before")
        try:
            self._connection.send_bytes(json.dumps({"command": command, **values}).encode())
        except OSError as error:
            raise self._gone(str(error)) from error

    def _answer(self, patience_s: float) -> tuple[Mapping[str, Any], bytes]:
        try:
            if not self._connection.poll(patience_s):
                raise self._gone(f"no answer within {patience_s:g} s")
            told = json.loads(self._connection.recv_bytes(LONGEST_MESSAGE))
            follows = self._connection.recv_bytes(LONGEST_MESSAGE) if told.get("bytes") else b""
        except (EOFError, OSError, ValueError) as error:
            raise self._gone(str(error) or "it closed the connection") from error
        return told, follows

    def _gone(self, why: str) -> LinkLost:
        self._lost = True
        return LinkLost(
            f"the server of the scanner at {self._address} does not answer ({why}): see whether `sms rig "
            "serve` runs there, and the network"
        )


def _connection(address: Address, key: bytes) -> Connection:
    try:
        # Found out first, because the client of the standard library waits for minutes.
        create_connection((address.host, address.port), _CONNECT_S).close()
        connection = Client((address.host, address.port))
        prompt(connection)
        if not connection.poll(_CONNECT_S):
            connection.close()
            raise LinkLost(
                f"the scanner at {address} is lent to another client: end what records with it, or wait"
            )
        answer_challenge(connection, key)
        deliver_challenge(connection, key)
    except AuthenticationError as error:
        raise LinkLost(
            f"the server of the scanner at {address} has another key: copy the file that `sms rig serve` "
            "names there"
        ) from error
    except (EOFError, OSError) as error:
        raise LinkLost(
            f"there is no server of a scanner at {address} ({error}): start `sms rig serve` there, and see "
            "whether the network and its firewall let it through"
        ) from error
    return connection


def wire_of(connection: Connection) -> socket:
    """Return the wire of a connection, which stays open when this is closed."""
    return fromfd(connection.fileno(), AF_INET, SOCK_STREAM)


def prompt(connection: Connection) -> None:
    """Have short messages sent at once, not when there are more of them."""
    with wire_of(connection) as wire:
        wire.setsockopt(IPPROTO_TCP, TCP_NODELAY, 1)


def as_told(error: Exception) -> dict[str, str]:
    """Return an error as a server tells it."""
    return {"error": str(error), "kind": type(error).__name__}


def _as_error(told: Mapping[str, Any]) -> SmsError:
    """Return the error that a server told, of the class that it had there."""
    kind = getattr(errors, str(told.get("kind")), None)
    if isinstance(kind, type) and issubclass(kind, SmsError):
        with suppress(TypeError):
            return kind(str(told["error"]))
    return DeviceFault(str(told["error"]))
