"""USB devices that exchange reports (HID), through the files that Linux has for them."""

from __future__ import annotations

import contextlib
import os
import select

from sms_jobs.errors import LinkLost

_REPORT_BYTES = 64
_NO_NUMBER = b"\0"
"""Before each report that is sent to a device whose reports are not numbered."""


class HidDevice:
    """A `Transport` of reports of 64 bytes over a file such as /dev/hidraw0.

    Raises
    ------
    LinkLost
        The file does not exist, may not be used, or the device is gone; the message names device and file.
    """

    def __init__(self, device: str, path: str) -> None:
        self._device = device
        self._path = path
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except OSError as error:
            raise LinkLost(
                f"{path} of '{device}' cannot be opened ({error.strerror}): check that its cable is plugged "
                "in, that the rig file names this file, and that you may use it (a rule of udev)"
            ) from error

    def write(self, data: bytes) -> None:
        """Send one report."""
        try:
            os.write(self._file, _NO_NUMBER + data)
        except OSError as error:
            raise self._lost(error) from error

    def read(self, timeout_s: float) -> bytes:
        """Return the next report, or nothing when none comes within the time."""
        try:
            ready, _, _ = select.select([self._file], [], [], timeout_s)
            return os.read(self._file, _REPORT_BYTES) if ready else b""
        except OSError as error:
            raise self._lost(error) from error

    def flush(self) -> None:
        """Discard the reports that have arrived."""
        while self.read(0.0):
            pass

    def close(self) -> None:
        """Close the file; may be called again."""
        if self._file >= 0:
            with contextlib.suppress(OSError):
                os.close(self._file)
            self._file = -1

    def _lost(self, error: OSError) -> LinkLost:
        return LinkLost(
            f"{self._path} of '{self._device}' broke ({error.strerror}): plug the cable in again, and resume"
        )
