"""Texts that people write and strangers bring: what may stand in them, how long they are, and how shown."""

from __future__ import annotations

import re
from typing import Final

from sms_jobs.errors import InvalidInput

NAME_LETTERS: Final = 64
"""Of whatever is found by its name."""
REMARK_LETTERS: Final = 10_000
"""Of what is said of something: a material, an origin, a reason."""
DOCUMENT_LETTERS: Final = 1 << 20
"""Of a text that is kept as a whole: a test plan."""

_UNPRINTABLE = re.compile(
    "[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\u2028\u2029\u202a-\u202e\u2066-\u2069]|\r(?!\n)"
)
"""What steers a terminal, turns the direction of a line, or is no character; line ends and tabs are none."""


def harmless(text: str) -> str:
    """Return a text as it may be printed: what would steer a terminal is written as its number."""
    return _UNPRINTABLE.sub(lambda found: _as_number(found[0]), text)


def unstored(text: str) -> str:
    """Return a text to be looked for: one that `checked_text` refuses is changed, and so found nowhere."""
    return _UNPRINTABLE.sub("\ufffd\ufffd", text)


def checked_text(text: str, what: str, most: int = REMARK_LETTERS) -> str:
    """Return a text that can be stored and shown; raise `InvalidInput`, saying what it is, if it cannot."""
    if len(text) > most:
        raise InvalidInput(
            f"{what} has {len(text)} letters, beginning with '{harmless(text[:40])}', and may have {most}: "
            "shorten it"
        )
    found = _UNPRINTABLE.search(text)
    if found is not None:
        raise InvalidInput(
            f"{what} holds {_as_number(found[0])}, which is no letter that can be printed, in "
            f"'{harmless(text[:40])}': leave it out"
        )
    return text


def _as_number(letter: str) -> str:
    code = ord(letter)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a name that is not in UTF-8
        code -= 0xDC00
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
