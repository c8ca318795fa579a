"""Text files of strangers: read whole, of bounded size, with errors that name the file."""

from __future__ import annotations

from pathlib import Path

from sms_jobs.errors import ConfigurationError, NotFound

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
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE_BYTES + 1)
    except FileNotFoundError:
        raise NotFound(f"there is no {what} {path}") from None
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) > LARGEST_FILE_BYTES:
        raise ConfigurationError(
            f"{path} is larger than the {LARGEST_FILE_BYTES} bytes that a {what} may have"
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path} is not UTF-8 text (byte {error.start}): save it as UTF-8") from None
