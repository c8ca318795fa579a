"""One request at a time: time limit, retries, replies that come too late."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from sms_jobs.errors import LinkLost
from sms_jobs.instruments.clock import Clock
from sms_jobs.instruments.codecs.decoder import Decoder
from sms_jobs.instruments.transports.transport import Transport
from sms_jobs.records.serial_links import SerialLink

Frame = TypeVar("Frame")
_BITS_A_BYTE = 10  # start, 8 data, stop
_PAUSE_S = 0.02
_HUSHES_AT_MOST = 20  # reply times; a device that never falls silent is not waited for


class Conversation(Generic[Frame]):
    """Asks a device and waits for what answers; the only one who writes to its wire.

    Parameters
    ----------
    device
        Its name, for messages.
    transport, link
        The wire, and how long replies are waited for.
    decoder
        Of what the device sends.
    unasked
        Given every frame that answers nothing; by default these are forgotten.
    """

    def __init__(
        self,
        device: str,
        transport: Transport,
        clock: Clock,
        decoder: Decoder[Frame],
        link: SerialLink,
        unasked: Callable[[Frame], None] | None = None,
    ) -> None:
        self.device = device
        self.clock = clock
        self.link = link
        self._transport = transport
        self._decoder = decoder
        self._unasked = unasked or (lambda _frame: None)
        self._lock = threading.RLock()

    def ask(
        self,
        request: bytes,
        answers: Callable[[Frame], bool],
        what: str,
        *,
        retries: int | None = None,
    ) -> Frame:
        """Send a request and return the first frame that answers it.

        Both queues are flushed before it is sent. Without an answer in time the line is left to fall silent,
        so that a late one does not answer another question, and the request is sent again.

        Raises
        ------
        LinkLost
            No answer came to any of the requests; the message says whether anything was heard.
        """
        with self._lock:
            heard = 0
            for attempt in range((self.link.retries if retries is None else retries) + 1):
                if attempt:
                    heard += self._hush()
                self.listen()
                self._transport.flush()
                self._decoder.reset()
                self._transport.write(request)
                answer, bytes_heard = self._answer(answers)
                heard += bytes_heard
                if answer is not None:
                    if attempt:
                        self._hush()
                    return answer
            raise self._lost(what, attempt + 1, heard + self._hush())

    def tell(self, request: bytes) -> None:
        """Send what nobody answers, and leave the devices the time to hear it before the next request."""
        with self._lock:
            self.listen()
            self._transport.flush()
            self._transport.write(request)
            self.clock.sleep(len(request) * _BITS_A_BYTE / self.link.baud_rate + _PAUSE_S)

    def listen(self, timeout_s: float = 0.0) -> None:
        """Hand out what the device sent unasked, or sends first within the time."""
        with self._lock:
            for frame in self._decoder.feed(self._transport.read(timeout_s)):
                self._unasked(frame)

    def close(self) -> None:
        """Let go of the wire."""
        with self._lock:
            self._transport.close()

    def _answer(self, answers: Callable[[Frame], bool]) -> tuple[Frame | None, int]:
        deadline = self.clock.monotonic() + self.link.reply_timeout_s
        found: Frame | None = None
        heard = 0
        while found is None and (left := deadline - self.clock.monotonic()) > 0.0:
            data = self._transport.read(left)
            heard += len(data)
            for frame in self._decoder.feed(data):
                if found is None and answers(frame):
                    found = frame
                else:
                    self._unasked(frame)
        return found, heard

    def _hush(self) -> int:
        """Wait until nothing was heard for as long as a reply may take; return how many bytes were."""
        heard = 0
        for _ in range(_HUSHES_AT_MOST):
            data = self._transport.read(self.link.reply_timeout_s)
            if not data:
                break
            heard += len(data)
            for frame in self._decoder.feed(data):
                self._unasked(frame)
        return heard

    def _lost(self, what: str, attempts: int, heard: int) -> LinkLost:
        if heard:
            clue = (
                f"{heard} bytes came, none of them an answer: check the baud rate ({self.link.baud_rate}), "
                "the protocol and the address in the rig file, and the cable's shield"
            )
        else:
            clue = "nothing came: check that it has power and that its cable is plugged in, then resume"
        return LinkLost(
            f"'{self.device}' on {self.link.port} did not answer {attempts} times within "
            f"{self.link.reply_timeout_s:g} s when it was asked for {what}; {clue}"
        )
