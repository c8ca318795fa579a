"""What jobs give to people and to other programs: files that no job reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sms_jobs.records.subject import Subject


@dataclass(frozen=True)
class Document:
    """A file for people or other programs that a kind makes.

    Attributes
    ----------
    name
        What it is, or the name of its format.
    media_type
        As of the files.
    keyed_by
        What tells several of one result apart, such as a camera; empty where there is one.
    """

    name: str
    media_type: str
    keyed_by: str = ""


@dataclass(frozen=True)
class DocumentOutput:
    """A file for people or other programs; `write` fills it at the path that it is given."""

    subject: Subject
    document: Document
    filename: str
    write: Callable[[Path], None]

    @property
    def media_type(self) -> str:
        """Of what it is declared to be."""
        return self.document.media_type
