"""Serial links: ports, framing of text, wires, and the faults that simulators commit on purpose."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import isfinite
from typing import Literal, TypeAlias

from sms_jobs.errors import InvalidInput

SIMULATED = "simulated"
"""The port of a device that is simulated in memory."""

FaultName: TypeAlias = Literal[
    "dropped-byte",
    "garbled-byte",
    "wrong-checksum",
    "late-reply",
    "unplugged",
    "tow-error",
    "soft-limit",
    "never-homed",
    "hunting-servo",
]
LINK_FAULTS = ("dropped-byte", "garbled-byte", "wrong-checksum", "late-reply", "unplugged")
"""Faults of the wire, which any serial device can have; the others are faults of axes."""


@dataclass(frozen=True)
class Fault:
    """Something that a simulator does wrong on purpose.

    Attributes
    ----------
    fault
        A fault of the wire is counted by replies (`unplugged` by requests, which get none), `never-homed`
        by homings, the other faults of axes by moves.
    at
        The first of these that it befalls; 1 is the first.
    times
        How many in a row; 0 for all that follow.
    axis
        Of a stage: `pan` or `tilt`; a fault of an axis befalls the pan axis when it is not given.
    amount
        Delay of a late reply, in s, and amplitude of a hunting servo, in rad.
    state
        Label of the load state at whose recording it happens; empty for any.
    """

    fault: FaultName
    at: int = 1
    times: int = 1
    axis: Literal["pan", "tilt"] = "pan"
    amount: float = 0.0
    state: str = ""

    def __post_init__(self) -> None:
        if self.at < 1 or self.times < 0:
            raise InvalidInput(
                f"fault {self.fault} has at = {self.at} and times = {self.times}: at counts from 1, and "
                "times is 1 or more, or 0 for ever"
            )
        if not (isfinite(self.amount) and self.amount >= 0.0):
            raise InvalidInput(
                f"fault {self.fault} has the amount {self.amount}: give 0 or a positive number"
            )

    def befalls(self, count: int) -> bool:
        """Return whether it happens at the `count`-th occasion, which are counted from 1."""
        return count >= self.at and (self.times == 0 or count < self.at + self.times)


@dataclass(frozen=True)
class SerialLink:
    """A serial port and how long its device is waited for; always 8 data bits, no parity, 1 stop bit.

    Attributes
    ----------
    port
        `/dev/ttyUSB0`, `COM3`, a pseudo-terminal, or `simulated`.
    baud_rate
        In bits per second.
    reply_timeout_s
        How long a reply may take. PowerCubes answer within 0.03 s a module; a USB adapter adds 0.016 s.
    retries
        How often a request is repeated before the device counts as unreachable.
    """

    port: str
    baud_rate: int = 9600
    reply_timeout_s: float = 0.1
    retries: int = 3

    def __post_init__(self) -> None:
        if not self.port:
            raise InvalidInput("a serial link needs a port, such as /dev/ttyUSB0, COM3 or simulated")
        if self.baud_rate <= 0 or self.reply_timeout_s <= 0.0 or self.retries < 0:
            raise InvalidInput(
                f"the link on {self.port} has {self.baud_rate} baud, time limit {self.reply_timeout_s} s "
                f"and {self.retries} retries: the first two must be positive, the last 0 or more"
            )


@dataclass(frozen=True)
class LineProtocol:
    r"""How lines of text are framed, checked and answered.

    Attributes
    ----------
    prefix
        What a request begins with, such as `@`.
    terminator, reply_terminator
        What ends a request, and what ends a reply: `\r\n`, `>`, ...; a prompt is a reply's terminator.
    checksum
        Two hexadecimal digits before the terminator of requests: sum or exclusive or of all before them.
    reply_checksum
        Whether replies bear the same checksum, which is then tested.
    accepted, refused
        Regular expressions, searched for in a reply. `refused` wins, and its group `error`, if it has one,
        is shown to people. A reply that neither fits is taken for garbled, and asked for again.
    """

    prefix: str = ""
    terminator: str = "\r\n"
    reply_terminator: str = "\r\n"
    checksum: Literal["none", "sum", "xor"] = "none"
    reply_checksum: bool = False
    accepted: str = r"^O"
    refused: str = r"^N(?P<error>.*)"

    def __post_init__(self) -> None:
        if not self.terminator or not self.reply_terminator:
            raise InvalidInput("a line protocol needs a terminator of requests and one of replies")
        for text in (self.prefix, self.terminator, self.reply_terminator):
            if not text.isascii():
                raise InvalidInput(f"a line protocol is made of ASCII; {text!r} is not")
        for name, pattern in (("accepted", self.accepted), ("refused", self.refused)):
            check_pattern(pattern, name)


@dataclass(frozen=True)
class Wire:
    """Which output of a controller or splitter leads to which camera or projector."""

    sensor: str
    output: int


def check_pattern(pattern: str, name: str, group: str = "") -> None:
    """Raise `InvalidInput` for what is no regular expression, or one without the group."""
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise InvalidInput(f"the regular expression {pattern!r} ({name}) cannot be read: {error}") from None
    if group and group not in compiled.groupindex:
        raise InvalidInput(
            f"the regular expression {pattern!r} ({name}) has no group '{group}': write (?P<{group}>...)"
        )
