"""Driver of devices that speak lines of text: trigger controllers, splitters, scalar instruments."""

from __future__ import annotations

from collections import deque

from sms_jobs.errors import DeviceFault, LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs.lines import LineDecoder, encode_line, interpret
from sms_jobs.instruments.codecs.scalars import reported_value
from sms_jobs.instruments.drivers.conversation import Conversation
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.instruments import SerialChannel
from sms_jobs.records.serial_links import LineProtocol, SerialLink


class LineDevice:
    """A device that answers each line with one."""

    def __init__(
        self, device: str, transport: Transport, clock: Clock, link: SerialLink, protocol: LineProtocol
    ) -> None:
        self.device = device
        self._protocol = protocol
        self._conversation = Conversation(device, transport, clock, LineDecoder.of_replies(protocol), link)

    def request(self, text: str, *, retries: int | None = None) -> str:
        """Send a line and return the reply; send it again as often as the rig file or `retries` allows.

        Raises
        ------
        LinkLost
            It does not answer, or in no form that the rig file knows.
        DeviceFault
            It refuses.
        """
        reply = self._conversation.ask(
            encode_line(self._protocol, text),
            lambda line: interpret(self._protocol, line) is not None,
            repr(text),
            retries=retries,
        )
        answer = interpret(self._protocol, reply)
        if answer is not None and answer.error is not None:
            raise DeviceFault(
                f"'{self.device}' refuses {text!r} with error {answer.error!r}: look it up in its manual, "
                "and compare the request in the rig file"
            )
        return reply

    def close(self) -> None:
        """Let go of the wire."""
        self._conversation.close()


class ScalarInstrument:
    """An instrument that tells one number, when it is asked or all the time."""

    def __init__(self, channel: SerialChannel, transport: Transport, clock: Clock) -> None:
        self._channel = channel
        self._clock = clock
        self._lines: deque[str] = deque(maxlen=1)
        decoder = LineDecoder.of_replies(channel.protocol)
        self._conversation = Conversation(
            channel.name, transport, clock, decoder, channel.link, self._lines.append
        )

    def value(self) -> float:
        """Return a value that is reported after the call.

        Raises
        ------
        LinkLost
            None is reported in time.
        DeviceFault
            It is reported in another unit than the channel is configured to.
        """
        text = self._asked() if self._channel.request else self._overheard()
        value = reported_value(self._channel, text)
        if value is None:
            raise DeviceFault(f"'{self._channel.name}' told {text!r}, in which there is no value")
        return value

    def close(self) -> None:
        """Let go of the wire."""
        self._conversation.close()

    def _asked(self) -> str:
        request = encode_line(self._channel.protocol, self._channel.request)
        return self._conversation.ask(request, self._has_value, "a value")

    def _overheard(self) -> str:
        self._conversation.listen()  # what was said before
        link = self._channel.link
        deadline = self._clock.monotonic() + link.reply_timeout_s * (link.retries + 1)
        self._lines.clear()
        first = True  # a line of which only the end may have been heard
        while (left := deadline - self._clock.monotonic()) > 0.0:
            self._conversation.listen(left)
            if self._lines:
                text = self._lines.popleft()
                if not first and self._has_value(text):
                    return text
                first = False
        raise LinkLost(
            f"'{self._channel.name}' on {link.port} sent no value within "
            f"{link.reply_timeout_s * (link.retries + 1):g} s: check its power and its cable, and that it "
            f"sends unasked, with the baud rate and format of the rig file"
        )

    def _has_value(self, text: str) -> bool:
        return reported_value(self._channel, text) is not None
