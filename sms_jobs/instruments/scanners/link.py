"""The client's end of a link to the server of a scanner, and what both ends say of errors.

Requests are JSON, an image may follow as bytes: nothing that is received is ever executed. Every request is
answered, in order.
"""

from __future__ import annotations

import secrets
import socket
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter

from sms_jobs import errors
from sms_jobs.errors import DeviceFault, InvalidInput, LinkLost, SmsError
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.scanners.proof import (
    CHALLENGE_BYTES,
    HELLO_BYTES,
    NONCE_BYTES,
    PROTOCOL,
    SessionKeys,
    client_proof,
    hello,
    protocol_of,
    same,
    server_proof,
    session_keys,
)
from sms_jobs.instruments.scanners.wire import SILENCE_S, Message, Wire, WireEnded
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import Deformation

SETTING = TypeAdapter(Setting)
SEQUENCE = TypeAdapter(FringeSequence)
DEFORMATION = TypeAdapter(tuple[Deformation, ...])

_CONNECT_S = 5.0
_PROOF_S = 5.0
"""What a server may take to prove that it has the key."""
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

    def __init__(
        self,
        address: Address,
        key: bytes,
        clock: Clock,
        setting: Setting | None,
        silence_s: float = SILENCE_S,
    ) -> None:
        """Connect and have the server connect its instruments.

        Raises
        ------
        LinkLost
            There is no server, it has another key, or it is lent to another client.
        InstrumentError
            One of its instruments does not answer.
        """
        self._address = address
        self._clock = clock
        self._owed = 0
        self._least_patience_s = 0.0
        self._wire = _proven(address, key, silence_s)
        try:
            described = None if setting is None else SETTING.dump_python(setting, mode="json")
            self.facts = self.ask("open", setting=described)[0]
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

    def ask(self, command: str, patience_s: float = _ANSWER_S, **values: Any) -> Message:
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
        answer: Message = ({}, bytearray())
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
        self._wire.close()

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
        try:
            self._wire.send({"command": command, **values})
        except WireEnded as error:
            raise self._gone(str(error)) from error

    def _answer(self, patience_s: float) -> Message:
        try:
            answer = self._wire.receive(patience_s)
        except WireEnded as error:
            raise self._gone(str(error)) from error
        if answer is None:
            raise self._gone(f"no answer within {patience_s:g} s")
        return answer

    def _gone(self, why: str) -> LinkLost:
        self._wire.close()  # a late answer would be taken for that to another question
        return LinkLost(
            f"the server of the scanner at {self._address} does not answer ({why}): see whether `sms rig "
            "serve` runs there, and the network"
        )


def _proven(address: Address, key: bytes, silence_s: float) -> Wire:
    """Connect with a server that knows the key, and prove that it is known here too."""
    try:
        wire = socket.create_connection((address.host, address.port), _CONNECT_S)
        try:
            keys = _prove(wire, address, key)
        except BaseException:
            wire.close()
            raise
    except OSError as error:
        raise LinkLost(
            f"there is no server of a scanner at {address} ({error}): start `sms rig serve` there, and see "
            "whether the network and its firewall let it through"
        ) from error
    return Wire(wire, keys.from_client, keys.from_server, silence_s)


def _prove(wire: socket.socket, address: Address, key: bytes) -> SessionKeys:
    """Prove to a server that the key is known, once it has done so itself."""
    ours = hello(secrets.token_bytes(NONCE_BYTES))
    wire.sendall(ours)
    answer = _taken(wire, CHALLENGE_BYTES, time.monotonic() + _PROOF_S)
    theirs, proof = answer[:HELLO_BYTES], answer[HELLO_BYTES:]
    spoken = protocol_of(theirs)
    if spoken != PROTOCOL:
        raise LinkLost(_other_protocol(address, spoken))
    if not same(proof, server_proof(key, ours, theirs)):
        raise LinkLost(
            f"the server of the scanner at {address} has another key: copy the file that `sms rig serve` "
            "names there"
        )
    wire.sendall(client_proof(key, ours, theirs))
    return session_keys(key, ours, theirs)


def _taken(wire: socket.socket, count: int, deadline: float) -> bytes:
    """Return so many bytes; raise `OSError` when they do not come in time."""
    taken = b""
    while len(taken) < count:
        left_s = deadline - time.monotonic()
        if left_s <= 0.0:
            raise TimeoutError(f"it did not prove within {_PROOF_S:g} s that it knows the key")
        wire.settimeout(left_s)
        try:
            got = wire.recv(count - len(taken))
        except TimeoutError:
            continue
        if not got:
            raise ConnectionResetError("it closed the connection")
        taken += got
    return taken


def _other_protocol(address: Address, spoken: int | None) -> str:
    if spoken is None:
        return f"what listens at {address} is no server of a scanner: correct the address in the rig file"
    return (
        f"the server of the scanner at {address} speaks version {spoken} of the protocol and this computer "
        f"version {PROTOCOL}: give both the same version of this program"
    )


def error_reply(error: Exception) -> dict[str, str]:
    """Return an error as a server tells it."""
    return {"error": str(error), "kind": type(error).__name__}


def _as_error(reply: Mapping[str, Any]) -> SmsError:
    """Return the error that a server replied with, of the class that it had there."""
    kind = getattr(errors, str(reply.get("kind")), None)
    if isinstance(kind, type) and issubclass(kind, SmsError):
        with suppress(TypeError):
            return kind(str(reply["error"]))
    return DeviceFault(str(reply["error"]))
