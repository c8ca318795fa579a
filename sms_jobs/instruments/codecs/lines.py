"""Lines of text: framing, terminator, prompt and checksum by configuration."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import reduce
from operator import xor

from sms_jobs.records.serial_links import LineProtocol

_LONGEST = 4096
"""Of a line; what is longer is noise."""


def encode_line(protocol: LineProtocol, text: str) -> bytes:
    """Return the bytes of a request."""
    body = (protocol.prefix + text).encode("ascii")
    return body + _checksum(protocol, body) + protocol.terminator.encode("ascii")


def encode_reply(protocol: LineProtocol, text: str) -> bytes:
    """Return the bytes of a reply."""
    body = text.encode("ascii")
    check = _checksum(protocol, body) if protocol.reply_checksum else b""
    return body + check + protocol.reply_terminator.encode("ascii")


@dataclass(frozen=True)
class Answer:
    """What a reply means: `error` is None when the request was accepted."""

    text: str
    error: str | None


def interpret(protocol: LineProtocol, text: str) -> Answer | None:
    """Return what a reply means; None when it fits neither expression and is taken for garbled."""
    refused = re.search(protocol.refused, text)
    if refused is not None:
        return Answer(text, (refused.groupdict().get("error") or text).strip())
    return Answer(text, None) if re.search(protocol.accepted, text) else None


def sum_hex(body: bytes) -> bytes:
    """Return the sum of bytes, modulo 256, as two hexadecimal digits."""
    return b"%02X" % (sum(body) & 0xFF)


def xor_hex(body: bytes) -> bytes:
    """Return the exclusive or of bytes as two hexadecimal digits."""
    return b"%02X" % reduce(xor, body, 0)


class LineDecoder:
    """Finds lines in a stream of bytes; those that are not ASCII, or have a wrong checksum, are left out.

    Attributes
    ----------
    refused
        How many lines were left out.
    """

    def __init__(self, terminator: str, checksum: str = "none") -> None:
        self.refused = 0
        self._terminator = terminator.encode("ascii")
        self._checksum = checksum
        self._bytes = bytearray()
        self._too_long = False

    @classmethod
    def of_replies(cls, protocol: LineProtocol) -> LineDecoder:
        """Return the decoder of what a device answers."""
        return cls(protocol.reply_terminator, protocol.checksum if protocol.reply_checksum else "none")

    @classmethod
    def of_requests(cls, protocol: LineProtocol) -> LineDecoder:
        """Return the decoder of what a device is asked."""
        return cls(protocol.terminator, protocol.checksum)

    def reset(self) -> None:
        """Forget the beginning of a line."""
        self._bytes.clear()
        self._too_long = False

    def feed(self, data: bytes) -> list[str]:
        """Take bytes and return the lines that they complete, without terminator and checksum."""
        self._bytes += data
        *complete, rest = self._bytes.split(self._terminator)
        lines = []
        for line in complete:
            text = None if self._too_long or len(line) > _LONGEST else self._text(bytes(line))
            self._too_long = False
            if text is None:
                self.refused += 1
            else:
                lines.append(text)
        if len(rest) > _LONGEST:
            self._too_long = True
            # The end may be the beginning of a terminator.
            rest = rest[len(rest) - len(self._terminator) + 1 :]
        self._bytes = bytearray(rest)
        return lines

    def _text(self, line: bytes) -> str | None:
        line = line.strip(b"\r\n\x00 ")
        if self._checksum != "none":
            body, check = line[:-2], line[-2:]
            expected = sum_hex(body) if self._checksum == "sum" else xor_hex(body)
            if check.upper() != expected:
                return None
            line = body
        return line.decode("ascii") if line.isascii() else None


def _checksum(protocol: LineProtocol, body: bytes) -> bytes:
    if protocol.checksum == "none":
        return b""
    return sum_hex(body) if protocol.checksum == "sum" else xor_hex(body)
