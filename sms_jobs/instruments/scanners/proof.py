"""How the two ends of a scanner's link prove to each other that they know its key: pure functions over bytes.

The caller says hello, with a random number. The server answers with one of its own and the proof that it
knows the key, for both numbers. Only then does the caller prove the same. A proof names the role of who
gives it, so that nobody's own proof is of use against him, and both numbers, so that none is of use again.
From the key and both numbers follow two keys of this link alone, one a direction.
"""

from __future__ import annotations

import hmac
import struct
from dataclasses import dataclass

PROTOCOL = 3
"""Of everything that passes over the link; both ends have to speak the same."""
NONCE_BYTES = 32
PROOF_BYTES = 32

_HELLO = struct.Struct(f"!8sI{NONCE_BYTES}s")
_NAME = b"sms-link"
HELLO_BYTES = _HELLO.size
CHALLENGE_BYTES = HELLO_BYTES + PROOF_BYTES


@dataclass(frozen=True)
class SessionKeys:
    """The keys of one link from its beginning to its end.

    Attributes
    ----------
    from_client, from_server
        For what one end sends and the other receives.
    """

    from_client: bytes
    from_server: bytes


def hello(nonce: bytes) -> bytes:
    """Return what either end says first: which protocol it speaks, and its random number."""
    return _HELLO.pack(_NAME, PROTOCOL, nonce)


def protocol_of(said: bytes) -> int | None:
    """Return the protocol that an end speaks; None if it is no end of a link."""
    name, protocol, _ = _HELLO.unpack(said)
    return int(protocol) if name == _NAME else None


def server_proof(key: bytes, from_client: bytes, from_server: bytes) -> bytes:
    """Return how a server proves to know the key, for what both ends said first."""
    return _derived(key, b"server", from_client, from_server)


def client_proof(key: bytes, from_client: bytes, from_server: bytes) -> bytes:
    """Return how a client proves to know the key, for what both ends said first."""
    return _derived(key, b"client", from_client, from_server)


def session_keys(key: bytes, from_client: bytes, from_server: bytes) -> SessionKeys:
    """Return the keys of a link, for what both ends said first."""
    return SessionKeys(
        _derived(key, b"messages of the client", from_client, from_server),
        _derived(key, b"messages of the server", from_client, from_server),
    )


def same(proof: bytes, expected: bytes) -> bool:
    """Tell whether two proofs are the same, in a time that does not tell how much of them is."""
    return hmac.compare_digest(proof, expected)


def _derived(key: bytes, purpose: bytes, from_client: bytes, from_server: bytes) -> bytes:
    """Return HMAC-SHA256 of a purpose and what both ends said first, which have fixed lengths."""
    return hmac.digest(key, from_client + from_server + purpose, "sha256")
