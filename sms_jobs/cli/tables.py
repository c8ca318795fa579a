"""Tables that fit the terminal: whatever is narrow, nothing is cut off."""

from __future__ import annotations

from collections.abc import Sequence

from rich.cells import cell_len
from rich.table import Column, Table

_BETWEEN = 2
"""Columns between two columns."""
_LEAST = 8
"""Columns that a column of sentences is left at least, if it has that many letters."""
_WHAT_IT_IS_ABOUT = ("subject", "campaign", "state", "schedule", "job", "file", "name")


def fitted(columns: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> Table:
    """Lay out a table whose texts are all shown whole, folded where they are too wide.

    Names, which have no spaces in them, keep to one line as long as there is room: first those that say what
    a row is about, then the others, the shortest first. Sentences and times are broken.

    Parameters
    ----------
    columns, rows
        Texts as the terminal is given them.
    width
        Of the terminal, in letters.
    """
    cells = list(zip(columns, *rows, strict=True)) if rows else [(c,) for c in columns]
    widths = [max(map(cell_len, texts)) for texts in cells]
    kept = _kept(cells, widths, width)
    laid_out = [
        Column(column, overflow="fold", width=widths[place] if place in kept else None)
        for place, column in enumerate(columns)
    ]
    table = Table(*laid_out, box=None, pad_edge=False, header_style="bold")
    for row in rows:
        table.add_row(*row)
    return table


def _kept(cells: Sequence[Sequence[str]], widths: Sequence[int], width: int) -> set[int]:
    """Return the columns that keep their full width."""
    least = [min(w, _LEAST) for w in widths]
    room = width - _BETWEEN * (len(widths) - 1) - sum(least)
    if sum(widths) - sum(least) <= room:
        return set()
    names = [place for place, texts in enumerate(cells) if not any(" " in text for text in texts)]
    kept = set()
    for place in sorted(names, key=lambda p: (cells[p][0] not in _WHAT_IT_IS_ABOUT, widths[p])):
        if widths[place] - least[place] <= room:
            room -= widths[place] - least[place]
            kept.add(place)
    return kept
