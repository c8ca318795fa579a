"""The key that the server of a scanner and its client share: a file of text."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from sms_jobs.errors import ConfigurationError

_LEAST_KEY = 16


def made_key(path: Path) -> bytes:
    """Return the key in a file, which is made where it is missing, for its owner alone."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "w") as file:
            file.write(secrets.token_hex(32) + "\n")
    return read_key(path)


def read_key(path: Path) -> bytes:
    """Return the key that a server and its client share; raise `ConfigurationError` where there is none."""
    try:
        key = path.read_bytes().strip()
    except OSError as error:
        raise ConfigurationError(
            f"the key of the scanner's server cannot be read from {path} ({error.strerror}): copy the file "
            "that `sms rig serve` names on the scanner's computer"
        ) from error
    if len(key) < _LEAST_KEY:
        raise ConfigurationError(
            f"the key in {path} has {len(key)} characters, at least {_LEAST_KEY} are needed: copy the file "
            "that `sms rig serve` names"
        )
    return key
