"""One end of a link after both have proven themselves: messages that nobody can change, and signs of life.

A message is a prefix (what it is, the lengths of its text and image), the tag of the prefix, text, image, and
the tag of these. A tag is HMAC-SHA256 under the key of the direction, over the number of the tag and what it
stands for: whatever is changed, repeated, left out, put in another order or sent back ends the link. An end
that has nothing to say beats, and one that hears nothing for a while gives the other up.
"""

from __future__ import annotations

import hmac
import json
import struct
import threading
from collections.abc import Mapping
from contextlib import suppress
from queue import Empty, SimpleQueue
from socket import IPPROTO_TCP, SHUT_RDWR, TCP_NODELAY, socket
from typing import Any

SILENCE_S = 10.0
"""An end that has said nothing for so long is gone: its power, its network, or its program."""
LONGEST_TEXT = 1 << 24
LONGEST_IMAGE = 1 << 30
"""In bytes: a frame of 500 megapixels."""

_BEATS = 5
"""So many signs of life are sent in the time after which none counts as an end."""
_BEAT, _MESSAGE = 0, 1
_PREFIX = struct.Struct("!BIQ")
_NUMBER = struct.Struct("!Q")
_TAG_BYTES = 32
_PIECE = 1 << 18


class WireEnded(Exception):
    """The other end is gone, or somebody interfered; the message says which."""


Message = tuple[Mapping[str, Any], bytearray]


class Tags:
    """The tags of one direction of a link, each for once.

    Parameters
    ----------
    key
        Of this direction.
    """

    def __init__(self, key: bytes) -> None:
        self._key = key
        self._number = 0

    def next(self, *parts: bytes | bytearray | memoryview) -> bytes:
        """Return the tag of what comes next in this direction."""
        tag = hmac.new(self._key, _NUMBER.pack(self._number), "sha256")
        self._number += 1
        for part in parts:
            tag.update(part)
        return tag.digest()


class Wire:
    """One end of a proven link; its methods may be called from several threads.

    Parameters
    ----------
    wire
        Connected; closed by `close`.
    sends, receives
        The keys of both directions.
    silence_s
        The other end is gone when it has said nothing for so long.
    """

    def __init__(self, wire: socket, sends: bytes, receives: bytes, silence_s: float = SILENCE_S) -> None:
        wire.setsockopt(IPPROTO_TCP, TCP_NODELAY, 1)
        wire.settimeout(silence_s)
        self._wire = wire
        self._sends = Tags(sends)
        self._receives = Tags(receives)
        self._silence_s = silence_s
        self._sending = threading.Lock()
        self._ended = threading.Event()
        self._why = ""
        self._messages: SimpleQueue[Message | None] = SimpleQueue()
        threading.Thread(target=self._hear, name="link-ear", daemon=True).start()
        threading.Thread(target=self._beat, name="link-heart", daemon=True).start()

    def send(self, message: Mapping[str, Any], image: bytes | memoryview = b"") -> None:
        """Send a message, with an image if there is one; raise `WireEnded` when the other end is gone."""
        self._send(_MESSAGE, json.dumps(message).encode(), image)

    def receive(self, patience_s: float | None = None) -> Message | None:
        """Return the next message, or None when none comes in time.

        Raises
        ------
        WireEnded
            The link has ended; the message says why.
        """
        try:
            message = self._messages.get(timeout=patience_s)
        except Empty:
            return None
        if message is None:
            self._messages.put(None)  # for whoever asks again
            raise WireEnded(self._why)
        return message

    def close(self) -> None:
        """End the link; the other end sees it at once."""
        self._end("it was closed here")
        with self._sending:
            self._wire.close()

    def _end(self, why: str) -> None:
        """End the link for a reason, of which the first counts."""
        if not self._ended.is_set():
            self._why = why
            self._ended.set()
        with suppress(OSError):  # it may be gone already
            self._wire.shutdown(SHUT_RDWR)
        self._messages.put(None)

    def _send(self, what: int, text: bytes, image: bytes | memoryview) -> None:
        prefix = _PREFIX.pack(what, len(text), len(image))
        with self._sending:
            if self._ended.is_set():
                raise WireEnded(self._why)
            try:
                head = prefix + self._sends.next(prefix) + text
                tag = self._sends.next(text, image) if what == _MESSAGE else b""
                if image:
                    self._put(head)
                    self._put(image)
                    self._put(tag)
                else:
                    self._put(head + tag)
            except OSError as error:
                self._end(_reason(error, self._silence_s))
                raise WireEnded(self._why) from error

    def _put(self, data: bytes | memoryview) -> None:
        """Send all of it, in pieces: each may take as long as the other end may be silent."""
        rest = memoryview(data)
        while rest:
            rest = rest[self._wire.send(rest[:_PIECE]) :]

    def _beat(self) -> None:
        """Give signs of life; what is being sent meanwhile is one."""
        while not self._ended.wait(self._silence_s / _BEATS):
            with suppress(WireEnded):
                self._send(_BEAT, b"", b"")

    def _hear(self) -> None:
        """Take what comes until the link ends."""
        try:
            while True:
                message = self._next()
                if message is not None:
                    self._messages.put(message)
        except (OSError, ValueError) as error:
            self._end(_reason(error, self._silence_s))
        finally:
            self._end("what it sent cannot be read")

    def _next(self) -> Message | None:
        """Return the next message, None for a sign of life; raise `ValueError` for anything else."""
        prefix = self._taken(_PREFIX.size)
        self._check(self._receives.next(prefix))
        what, text_bytes, image_bytes = _PREFIX.unpack(prefix)
        if what == _BEAT:
            return None
        if text_bytes > LONGEST_TEXT or image_bytes > LONGEST_IMAGE:
            raise ValueError(
                f"a message of {text_bytes + image_bytes} bytes came, at most {LONGEST_IMAGE} are taken"
            )
        text, image = self._taken(text_bytes), self._taken(image_bytes)
        self._check(self._receives.next(text, image))
        message = json.loads(text)
        if isinstance(message, dict):
            return message, image
        raise ValueError("a message came that is no JSON object")

    def _check(self, expected: bytes) -> None:
        if not hmac.compare_digest(self._taken(_TAG_BYTES), expected):
            raise ValueError(
                "a message was changed on its way: something on the network between both is broken or hostile"
            )

    def _taken(self, count: int) -> bytearray:
        taken = bytearray(count)
        rest = memoryview(taken)
        while rest:
            got = self._wire.recv_into(rest)
            if got == 0:
                raise ConnectionResetError("it closed the connection")
            rest = rest[got:]
        return taken


def _reason(error: Exception, silence_s: float) -> str:
    if isinstance(error, TimeoutError):
        return f"no sign of life for {silence_s:g} s"
    return str(error)
