"""Files of strangers: read whole, of bounded size, with errors that name the file."""

from __future__ import annotations

import stat
from pathlib import Path

from sms_jobs.errors import ConfigurationError, InvalidInput, NotFound
from sms_jobs.records.texts import DOCUMENT_LETTERS, checked_text

LARGEST_FILE_BYTES = 1 << 20
DEEPEST = 24
"""How deeply a file may be nested."""


def read_text(path: Path, what: str) -> str:
    """Return the text of a file; `what` it should be is said in messages.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        It cannot be read, is too large, or is not UTF-8.
    """
    content = read_bytes(path, what, LARGEST_FILE_BYTES)
    try:
        return checked_text(content.decode("utf-8-sig"), str(path), DOCUMENT_LETTERS)
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path} is not UTF-8 text (byte {error.start}): save it as UTF-8") from None
    except InvalidInput as error:
        raise ConfigurationError(str(error)) from None


def read_bytes(path: Path, what: str, most: int) -> bytes:
    """Return what a regular file holds; devices and pipes, which may never end, are not even opened.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        It is no regular file, cannot be read, or is larger than `most` bytes.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ConfigurationError(f"{path} cannot be read: it is no regular file; give a {what}")
        with path.open("rb") as file:
            content = file.read(most + 1)
    except FileNotFoundError:
        raise NotFound(f"there is no {what} {path}") from None
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from error
    if len(content) > most:
        raise ConfigurationError(f"{path} is larger than the {most} bytes that a {what} may have")
    return content
