"""Trigger controllers, splitters and scalar instruments behind their bytes."""

from __future__ import annotations

import re
from collections.abc import Callable
from string import Formatter

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.codecs.lines import LineDecoder, encode_reply, interpret
from sms_jobs.instruments.codecs.scalars import reported_value
from sms_jobs.records.instruments import SerialChannel, TriggerController, VideoSplitter
from sms_jobs.records.serial_links import LineProtocol

_ACCEPTANCES = ("O", "OK", "*", "ACK", "R", "")
_REFUSALS = ("N01", "Error 1: unknown command", "ERR 1", "ERR", "?", "! unknown command", "NAK")
_SPEAKS_EVERY_S = 0.1


class SimulatedLineDevice:
    """A controller or splitter that knows the requests of its configuration, and no others.

    Attributes
    ----------
    selected
        The output that was selected last; None before.
    triggers
        Outputs that were triggered, in this order, with their times in s.
    """

    def __init__(self, device: TriggerController | VideoSplitter) -> None:
        self.selected: int | None = None
        self.triggers: list[tuple[float, int]] = []
        self._protocol = device.protocol
        self._outputs = {wire.output for wire in device.wiring}
        self._select = _pattern(device.select)
        self._trigger = _pattern(device.trigger) if isinstance(device, TriggerController) else None
        self._plain = device.configure if isinstance(device, TriggerController) else ()
        self._accepts = _fitting(device.name, device.protocol, accepted=True)
        self._refuses = _fitting(device.name, device.protocol, accepted=False)
        self._decoder = LineDecoder.of_requests(device.protocol)

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes and return the replies."""
        replies = []
        for line in self._decoder.feed(data):
            accepted = self._obey(line.removeprefix(self._protocol.prefix), now)
            replies.append(encode_reply(self._protocol, self._accepts if accepted else self._refuses))
        return replies

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        """Return nothing: the device speaks when it is asked."""
        return []

    def next_event(self) -> float | None:
        """Return None: it never speaks unasked."""
        return None

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        """Return a reply whose checksum is wrong, or that is garbled where replies have none."""
        end = len(self._protocol.reply_terminator)
        if not self._protocol.reply_checksum:
            return bytes((reply[0] ^ 0x80,)) + reply[1:]
        digit = b"0" if reply[-end - 1 : -end] != b"0" else b"1"
        return reply[: -end - 1] + digit + reply[-end:]

    def _obey(self, text: str, now: float) -> bool:
        if text in self._plain:
            return True
        for pattern, act in ((self._select, self._on_select), (self._trigger, self._on_trigger)):
            match = pattern.fullmatch(text) if pattern else None
            if match:
                # A request without an output means the one that is selected, or the first.
                number = match.groupdict().get("output")
                output = int(number) if number else self.selected or min(self._outputs)
                if output not in self._outputs:
                    return False
                act(output, now)
                return True
        return False

    def _on_select(self, output: int, now: float) -> None:
        self.selected = output

    def _on_trigger(self, output: int, now: float) -> None:
        self.triggers.append((now, output))


class SimulatedScalar:
    """An instrument that tells a number which changes with time.

    Parameters
    ----------
    channel
        How it speaks.
    value
        The value at a time, in the channel's unit.
    """

    def __init__(self, channel: SerialChannel, value: Callable[[float], float]) -> None:
        self._channel = channel
        self._value = value
        self._write = _writer(channel)
        self._decoder = LineDecoder.of_requests(channel.protocol)
        self._next = 0.0 if not channel.request else None

    def receive(self, data: bytes, now: float) -> list[bytes]:
        """Take bytes and return the replies."""
        request = self._channel.protocol.prefix + self._channel.request
        return [
            self._encoded_reading(now)
            for line in self._decoder.feed(data)
            if self._channel.request and line == request
        ]

    def speak(self, now: float) -> list[tuple[float, bytes]]:
        """Return values that it tells by itself, when it is not one that is asked."""
        if self._next is None or now < self._next:
            return []
        sent_at, self._next = self._next, now + _SPEAKS_EVERY_S
        return [(sent_at, self._encoded_reading(now))]

    def next_event(self) -> float | None:
        """Return when it tells its next value by itself."""
        return self._next

    def with_wrong_checksum(self, reply: bytes) -> bytes:
        """Return a garbled reply."""
        return bytes((reply[0] ^ 0x80,)) + reply[1:]

    def _encoded_reading(self, now: float) -> bytes:
        raw = (self._value(now) - self._channel.offset) / self._channel.scale
        return encode_reply(self._channel.protocol, self._write(raw))


def _pattern(template: str) -> re.Pattern[str] | None:
    """Return what matches the requests that a template makes; None for an empty one."""
    if not template:
        return None
    parts = []
    for literal, name, _form, _conversion in Formatter().parse(template):
        parts.append(re.escape(literal))
        if name is not None:
            parts.append(r"(?P<output>\d+)" if "(?P<output>" not in "".join(parts) else r"\d+")
    return re.compile("".join(parts))


def _fitting(name: str, protocol: LineProtocol, *, accepted: bool) -> str:
    for text in _ACCEPTANCES if accepted else _REFUSALS:
        answer = interpret(protocol, text)
        if answer is not None and (answer.error is None) == accepted:
            return text
    raise InvalidInput(
        f"'{name}' cannot be simulated: none of the replies {', '.join(map(repr, _ACCEPTANCES + _REFUSALS))} "
        f"fits its expression for {'accepted' if accepted else 'refused'} requests"
    )


def _writer(channel: SerialChannel) -> Callable[[float], str]:
    """Return how to write a number so that the channel's expression reads it again."""
    unit = channel.reported_unit
    forms = [
        f"{sign}{form}{gap}{unit}"
        for form in ("08.3f}", ".3f}")
        for sign in ("{:+", "{:")
        for gap in ("", " ")
    ]
    expected = 12.5 * channel.scale + channel.offset
    for form in (*forms, *("ST,GS," + form for form in forms)):
        value = reported_value(channel, form.format(12.5)) if unit in form else None
        if value is not None and abs(value - expected) <= 1e-9 * max(1.0, abs(expected)):
            return form.format
    raise InvalidInput(
        f"channel '{channel.name}' cannot be simulated: its expression {channel.reply!r} reads none of the "
        f"forms that the simulator writes, such as {forms[0].format(12.5)!r}"
    )
