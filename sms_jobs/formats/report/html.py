"""The pieces of a report: text, tables and pictures as HTML.

Everything that comes from a person or a file passes through `html.escape`.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from math import isfinite

NOTHING = "–"


@dataclass(frozen=True)
class Markup:
    """HTML that is safe as it is; the functions below make it of plain text."""

    html: str


class Given(float):
    """A number that a person gave: it is shown as it was given, not rounded."""


Cell = str | float | int | None | Markup
"""Of a table: text is escaped, numbers are rounded to four digits, None is a dash."""


def code(plain: str, title: str = "") -> Markup:
    """Show text in the letters of a programme; `title` appears under a pointer."""
    shown = f' title="{escape(title)}"' if title else ""
    return Markup(f"<code{shown}>{escape(plain)}</code>")


def number(value: float | int | None) -> str:
    """Write a number with four digits; a dash for one that is missing or not finite."""
    if value is None or not isfinite(value):
        return NOTHING
    if isinstance(value, int):
        return str(value)
    if isinstance(value, Given):
        return f"{value:.12g}"
    return f"{value:.0f}" if 1e4 <= abs(value) < 1e9 else f"{value:.4g}"


def paragraph(plain: str, faint: bool = False) -> Markup:
    """Make a paragraph of plain text."""
    return Markup(f"<p{' class=faint' if faint else ''}>{escape(plain)}</p>")


def _cell(value: Cell, right: bool) -> str:
    aligned = ' class="number"' if right else ""
    if isinstance(value, Markup):
        return f"<td{aligned}>{value.html}</td>"
    return f"<td{aligned}>{escape(value) if isinstance(value, str) else number(value)}</td>"


def table(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> Markup:
    """Make a table that scrolls sideways where the screen is narrow; columns of numbers lean right."""
    numeric = [
        any(isinstance(row[place], int | float) for row in rows)
        and not any(isinstance(row[place], str | Markup) for row in rows)
        for place in range(len(header))
    ]
    head = "".join(
        f'<th scope="col"{" class=number" if right else ""}>{escape(name)}</th>'
        for name, right in zip(header, numeric, strict=True)
    )
    body = "".join(
        f"<tr>{''.join(_cell(value, right) for value, right in zip(row, numeric, strict=True))}</tr>\n"
        for row in rows
    )
    return Markup(
        f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>'
    )


def facts(pairs: Iterable[tuple[str, str]]) -> Markup:
    """Make a table of names and what they stand for; those that stand for nothing are left out."""
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(value)}</td></tr>\n'
        for name, value in pairs
        if value
    )
    return Markup(f'<div class="wide"><table><tbody>\n{body}</tbody></table></div>')


def figure(png: bytes, caption: str) -> Markup:
    """Make a picture with a caption, which is also its text for screen readers."""
    data = base64.b64encode(png).decode("ascii")
    words = escape(caption)
    return Markup(
        f'<figure><img alt="{words}" src="data:image/png;base64,{data}">'
        f"<figcaption>{words}</figcaption></figure>"
    )


def figures(pictures: Iterable[Markup]) -> Markup:
    """Put pictures side by side where there is room."""
    return Markup(f'<div class="figures">{"".join(picture.html for picture in pictures)}</div>')


def folded(summary: str, content: Markup) -> Markup:
    """Hide something behind a line that opens it."""
    return Markup(f"<details><summary>{escape(summary)}</summary>{content.html}</details>")
