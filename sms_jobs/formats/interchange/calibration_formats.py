"""What a reader of calibration files says of itself: a module here that has a `FORMAT` is found by itself.

OpenCV's files have none: several of them can complete each other, and whatever no format knows is taken for
one of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

from sms_jobs.discovery import declared
from sms_jobs.formats.interchange.found_sensors import FoundCalibration
from sms_jobs.formats.interchange.xml_elements import Element, parse_xml


@dataclass(frozen=True)
class Document:
    """A file as it is looked at: its name for messages, its text and, of XML, the outermost element."""

    source: str
    text: str
    root: Element | None


@dataclass(frozen=True)
class CalibrationFormat:
    """A layout of calibration files.

    Attributes
    ----------
    name
        What its files are called.
    fits
        Tells whether a document is one of them, whole or damaged.
    find
        Returns what it says; raises `ConfigurationError` where that is wrong.
    """

    name: str
    fits: Callable[[Document], bool]
    find: Callable[[Document], FoundCalibration]


def document_of(text: str, source: str) -> Document:
    """Return a text as a document; raise `ConfigurationError` for XML that is not well-formed or not safe."""
    return Document(source, text, parse_xml(text, source) if text.lstrip()[:1] == "<" else None)


@cache
def all_formats() -> dict[str, CalibrationFormat]:
    """Return every format by name."""
    return declared("sms_jobs.formats.interchange", "FORMAT")


def format_of(document: Document) -> CalibrationFormat | None:
    """Return the format of a document, None where none fits."""
    return next((one for one in all_formats().values() if one.fits(document)), None)
