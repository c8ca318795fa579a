"""The key that the server of a scanner and its client share: a file of text."""

from __future__ import annotations

import os
import re
import secrets
from pathlib import Path

from sms_jobs.errors import ConfigurationError

_KEY_BYTES = 32
_KEY = re.compile(rb"[0-9a-f]{%d}" % (2 * _KEY_BYTES))


def made_key(path: Path) -> bytes:
    """Return the key in a file, which is made where it is missing, for its owner alone."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(_KEY_BYTES) + "\n")
    return read_key(path)


def read_key(path: Path) -> bytes:
    """Return the key that a server and its client share; raise `ConfigurationError` where there is none.

    A key that somebody thought of could be found by trying, from one proof that anybody can ask for; so it
    has to be as random as one that was made here.
    """
    try:
        text = path.read_bytes().strip()
    except OSError as error:
        raise ConfigurationError(
            f"the key of the scanner's server cannot be read from {path} ({error.strerror}): copy the file "
            "that `sms rig serve` names on the scanner's computer"
        ) from error
    if not _KEY.fullmatch(text):
        raise ConfigurationError(
            f"{path} holds no key of {2 * _KEY_BYTES} hexadecimal digits but {len(text)} bytes of something "
            "else: copy the file that `sms rig serve` made on the scanner's computer"
        )
    return bytes.fromhex(text.decode())
