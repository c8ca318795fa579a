"""Texts that are sent in place of the files that commands read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from sms_jobs.errors import SmsError


@contextmanager
def text_as_file(text: str, name: str) -> Iterator[Path]:
    """Lay a text into a file, which is gone afterwards; refusals name it without its folder."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_text(text, encoding="utf-8")
        try:
            yield file
        except SmsError as error:
            raise type(error)(str(error).replace(str(file), name)) from error
