"""What a file comes from, drawn as SVG: what was measured on the left, the file itself on the right."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from markupsafe import Markup

from sms_jobs.app.holdings.files import Tree
from sms_jobs.records.shown.files import Ancestor, FileView
from sms_jobs.records.sizes import number_of

_WIDTH, _HEIGHT, _ACROSS, _DOWN, _EDGE = 190, 40, 240, 54, 6
_LETTERS = 26
_MOST = 60
"""Files that are drawn; a page is no place for hundreds."""


@dataclass(frozen=True)
class _Edge:
    role: str
    above: int
    below: int


def drawn(tree: Tree) -> Markup:
    """Return the graph of a file and its ancestors, each a link to its page; `_MOST` files at most."""
    files = {tree.file.id: tree.file}
    edges = list(_edges(tree.file.id, tree.inputs, files))
    columns = _columns(tree.file.id, edges)
    rows: defaultdict[int, list[int]] = defaultdict(list)
    for number, column in columns.items():
        rows[column].append(number)
    last = max(rows)
    tallest = max(map(len, rows.values()))
    places = {
        number: (
            _EDGE + (last - column) * _ACROSS,
            _EDGE + round((place + (tallest - len(own)) / 2) * _DOWN),
        )
        for column, own in rows.items()
        for place, number in enumerate(own)
    }
    width, height = 2 * _EDGE + last * _ACROSS + _WIDTH, 2 * _EDGE + (tallest - 1) * _DOWN + _HEIGHT
    words = f"{number_of(len(files), 'file')} from which {tree.file.source} {tree.file.subject} comes"
    start = Markup('<svg viewBox="0 0 {} {}" width="{}" role="group" aria-label="{}">').format(
        width, height, width, words
    )
    lines = Markup("").join(_line(edge, places) for edge in edges)
    boxes = Markup("").join(_box(files[n], *places[n], n == tree.file.id) for n in places)
    left_out = tree.more or len(files) >= _MOST
    more = (
        Markup('<p class="faint">There is more before it, which is not drawn.</p>')
        if left_out
        else Markup("")
    )
    return start + lines + boxes + Markup("</svg>") + more


def _edges(above: int, inputs: Iterable[Ancestor], files: dict[int, FileView]) -> Iterator[_Edge]:
    for one in inputs:
        if one.file.id not in files and len(files) >= _MOST:
            continue
        files[one.file.id] = one.file
        yield _Edge(one.role, above, one.file.id)
        yield from _edges(one.file.id, one.inputs, files)


def _columns(root: int, edges: Iterable[_Edge]) -> dict[int, int]:
    """Return how many steps each file is away from the root, by the longest way."""
    inputs: defaultdict[int, list[int]] = defaultdict(list)
    for edge in edges:
        inputs[edge.above].append(edge.below)
    columns, level = {root: 0}, [root]
    for column in range(1, len(inputs) + 1):
        level = list(dict.fromkeys(below for above in level for below in inputs[above]))
        columns |= dict.fromkeys(level, column)
    return columns


def _line(edge: _Edge, places: dict[int, tuple[int, int]]) -> Markup:
    (to_x, to_y), (from_x, from_y) = places[edge.above], places[edge.below]
    left, top, right, bottom = from_x + _WIDTH, from_y + _HEIGHT // 2, to_x, to_y + _HEIGHT // 2
    middle = (left + right) // 2
    return Markup('<path d="M{} {}C{} {} {} {} {} {}"><title>{}</title></path>').format(
        left, top, middle, top, middle, bottom, right, bottom, edge.role
    )


def _box(file: FileView, x: int, y: int, own: bool) -> Markup:
    return Markup(
        '<a href="/archive/{}"{}><title>{}</title><rect x="{}" y="{}" width="{}" height="{}" rx="4"/>'
        '<text x="{}" y="{}">{}</text><text class="faint" x="{}" y="{}">{}</text></a>'
    ).format(
        file.id,
        Markup(' class="own"') if own else "",
        f"{file.source} {file.subject}",
        *(x, y, _WIDTH, _HEIGHT),
        *(x + 8, y + 17, file.source[:_LETTERS]),
        *(x + 8, y + 32, _end(file.subject or file.path)),
    )


def _end(text: str) -> str:
    """Return as much of the end of a text as fits into a box."""
    return text if len(text) <= _LETTERS else f"…{text[1 - _LETTERS :]}"
