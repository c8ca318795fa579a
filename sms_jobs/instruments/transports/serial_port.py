"""Serial ports and pseudo-terminals, through pyserial."""

from __future__ import annotations

import contextlib

import serial

from sms_jobs.errors import LinkLost
from sms_jobs.records.serial_links import SerialLink


class SerialPort:
    """A `Transport` over a serial port: 8N1, no flow control, for this program alone.

    Raises
    ------
    LinkLost
        The port does not exist, belongs to another program, or breaks; the message names device and port.
    """

    def __init__(self, device: str, link: SerialLink) -> None:
        self._device = device
        self._link = link
        try:
            self._port = serial.Serial(
                link.port, link.baud_rate, timeout=link.reply_timeout_s, write_timeout=2.0, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise LinkLost(
                f"port {link.port} of '{device}' cannot be opened ({_reason(error)}): check that the cable "
                "is plugged in, that the rig file names this port, that you may use it (group dialout), and "
                "that no other program does"
            ) from error

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        try:
            self._port.write(data)
            self._port.flush()
        except OSError as error:  # pyserial's exceptions are OSErrors
            raise self._lost(error) from error

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, or what arrives first within the time."""
        try:
            self._port.timeout = timeout_s
            first: bytes = self._port.read(1)
            return first + bytes(self._port.read(self._port.in_waiting)) if first else b""
        except (OSError, TypeError) as error:  # a TypeError where the port was closed while it was read
            raise self._lost(error) from error

    def flush(self) -> None:
        """Discard both queues."""
        try:
            self._port.reset_output_buffer()
            self._port.reset_input_buffer()
        except OSError as error:
            raise self._lost(error) from error
        except Exception as error:
            # The queues of a terminal that hung up are refused with an exception of termios's own.
            if type(error).__module__ == "termios":
                raise self._lost(error) from error
            raise

    def close(self) -> None:
        """Close the port."""
        with contextlib.suppress(OSError):
            self._port.close()

    def _lost(self, error: Exception) -> LinkLost:
        return LinkLost(
            f"port {self._link.port} of '{self._device}' broke ({_reason(error)}): plug the cable in again, "
            "and resume"
        )


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error) or type(error).__name__).splitlines()[0]
