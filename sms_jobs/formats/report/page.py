"""The frame of a report: one HTML page that needs nothing but itself.

Style, script, pictures and data are inside the page, so that it can be mailed, printed and read in twenty
years. Its Content-Security-Policy lets no other script or style run than these two, by their hashes, and lets
nothing be fetched: even text that escaped our care could do no harm.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cache
from html import escape
from importlib.resources import files
from io import StringIO
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import IO, Any, TextIO

from sms_jobs.formats.drawing.assets import drawing_script, drawing_style
from sms_jobs.formats.look import look
from sms_jobs.formats.report.html import Markup

_COPIED = 1 << 20


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading of its own; `level` 3 stands below one of 2."""

    title: str
    content: Sequence[Markup]
    level: int = 2


@cache
def _resource(name: str) -> str:
    return files("sms_jobs.formats.report").joinpath(name).read_text(encoding="utf-8")


@cache
def style() -> str:
    """Return the style of every page."""
    return f"{look()}{drawing_style()}{_resource('page.css')}"


@cache
def script() -> str:
    """Return the script of every page."""
    return f'"use strict";\n(() => {{\n{drawing_script()}\n{_resource("page.js")}\n}})();\n'


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def policy() -> str:
    """Return what the page allows itself: its own style and script, pictures inside it, nothing else."""
    return (
        f"default-src 'none'; style-src 'sha256-{_digest(style())}'; "
        f"script-src 'sha256-{_digest(script())}'; img-src data:; base-uri 'none'; form-action 'none'"
    )


def json_block(about: Any, kind: str) -> Markup:
    """Return data that the script reads and never runs; nothing in it can end the element."""
    text = json.dumps(about, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for letter in "<>&\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return Markup(f'<script type="application/json" class="{escape(kind)}">{text}</script>')


def _on_the_disk() -> IO[str]:
    return TemporaryFile("w+", encoding="utf-8", newline="")


@dataclass
class Part:
    """A piece of the body that is written before it is known what stands above it; it lies on the disk."""

    out: IO[str] = field(default_factory=_on_the_disk)

    def add(self, *markup: Markup) -> None:
        """Write something at the end."""
        for piece in markup:
            self.out.write(piece.html)
            self.out.write("\n")

    def __enter__(self) -> Part:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.out.close()


class Page:
    """Writes a page from top to bottom.

    Parameters
    ----------
    out
        Where to.
    title
        Of the page.
    introduction
        What stands below the title.
    contents
        Titles of the sections of level 2 in order, for the links at the top.
    """

    def __init__(
        self, out: TextIO, title: str, introduction: Iterable[Markup], contents: Sequence[str] = ()
    ) -> None:
        self._out = out
        self._sections = 0
        links = " ".join(
            f'<a href="#s{place}">{escape(name)}</a>' for place, name in enumerate(contents, start=1)
        )
        out.write(
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{escape(policy())}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta name="referrer" content="no-referrer">\n<meta name="color-scheme" content="light dark">\n'
            f"<title>{escape(title)}</title>\n<style>{style()}</style>\n</head>\n<body>\n"
            f"<header>\n<h1>{escape(title)}</h1>\n"
        )
        self.add(*introduction)
        if links:
            out.write(f'<nav aria-label="Contents">{links}</nav>\n')
        out.write("</header>\n<main>\n")

    def add(self, *markup: Markup) -> None:
        """Write something at the end."""
        for piece in markup:
            self._out.write(piece.html)
            self._out.write("\n")

    def section(self, section: Section) -> None:
        """Write a section; those of level 2 have the anchors of the links."""
        anchor = ""
        if section.level == 2:
            self._sections += 1
            anchor = f' id="s{self._sections}"'
        self.add(Markup(f"<h{section.level}{anchor}>{escape(section.title)}</h{section.level}>"))
        self.add(*section.content)

    def copy(self, part: Part) -> None:
        """Write what a part holds, a piece at a time."""
        part.out.seek(0)
        while text := part.out.read(_COPIED):
            self._out.write(text)

    def end(self) -> None:
        """Write the script and the end."""
        self._out.write(f"</main>\n<script>{script()}</script>\n</body>\n</html>\n")


def page(title: str, introduction: Iterable[Markup], sections: Sequence[Section]) -> str:
    """Return a whole page that fits into memory."""
    out = StringIO()
    made = Page(out, title, introduction, [s.title for s in sections if s.level == 2])
    for section in sections:
        made.section(section)
    made.end()
    return out.getvalue()


def page_writer(document: str) -> Callable[[Path], None]:
    """Return what writes a page into a file, the same on every system."""

    def write(path: Path) -> None:
        path.write_text(document, encoding="utf-8", newline="\n")

    return write
