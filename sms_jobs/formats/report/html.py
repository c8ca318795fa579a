"""The pieces of a report: one HTML page that needs nothing but itself.

Everything that comes from a person or a file passes through `html.escape`. The page has no script, its style
is inside it and its pictures are data, so that it can be mailed, printed and read in twenty years.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from math import isfinite

NOTHING = "–"

_STYLE = """
:root { color-scheme: light dark; --ink: #1c1f24; --paper: #ffffff; --soft: #f3f4f6; --line: #d5d9df;
  --faint: #5d6672; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e6ea; --paper: #16181c; --soft: #22262c;
  --line: #3a4049; --faint: #9aa3ae; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 80rem; color: var(--ink); background: var(--paper);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.6rem; margin: .4rem 0; } h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem;
  border-bottom: 1px solid var(--line); padding-bottom: .2rem; }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .4rem; }
p { margin: .4rem 0; max-width: 50rem; } .faint { color: var(--faint); font-size: .9rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; font-variant-numeric: tabular-nums; margin: .5rem 0; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { background: var(--soft); font-weight: 600; }
td.number, th.number { text-align: right; } td.number { white-space: nowrap; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 17rem), 1fr)); gap: 1rem;
  margin: .6rem 0 1.2rem; }
figure { margin: 0; } figure img { width: 100%; max-width: 40rem; height: auto; border-radius: 4px;
  background: #ffffff; }
figcaption { font-size: .85rem; color: var(--faint); }
code { font-size: .85em; overflow-wrap: anywhere; } nav a { margin-right: 1rem; color: inherit; }
summary { cursor: pointer; }
@media print { :root { --ink: #000000; --paper: #ffffff; --soft: #f0f0f0; --line: #bbbbbb; --faint: #444444; }
  body { padding: 0; max-width: none; font-size: 10pt; } nav { display: none; } figure, tr, h2, h3 {
  break-inside: avoid; } h2, h3 { break-after: avoid; } .figures { grid-template-columns: 1fr 1fr; }
  .wide { overflow: visible; } }
"""


@dataclass(frozen=True)
class Markup:
    """HTML that is safe as it stands; plain text becomes this by `text`."""

    html: str


class Given(float):
    """A number that a person gave: it is shown as it was given, not rounded."""


Cell = str | float | int | None | Markup
"""Of a table: text is escaped, numbers are rounded to four digits, None is a dash."""


def text(plain: str) -> Markup:
    """Escape plain text."""
    return Markup(escape(plain))


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
        f"<th{' class=number' if right else ''}>{escape(name)}</th>"
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
    """Make a picture with a caption, which is also what a reader without eyes is told."""
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


@dataclass(frozen=True)
class Section:
    """A part of the page with a heading of its own; `level` 3 stands below one of 2."""

    title: str
    content: Sequence[Markup]
    level: int = 2


def page(title: str, introduction: Sequence[Markup], sections: Sequence[Section]) -> str:
    """Return the whole page, with a line of links to its sections."""
    links = []
    parts = []
    for place, section in enumerate(sections):
        heading = f'<h{section.level} id="s{place}">{escape(section.title)}</h{section.level}>'
        parts.append(heading + "\n".join(part.html for part in section.content))
        if section.level == 2:
            links.append(f'<a href="#s{place}">{escape(section.title)}</a>')
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n"
        + "\n".join(part.html for part in introduction)
        + f"\n<nav>{' '.join(links)}</nav>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )
