"""What a study is: a question, an experiment that answers it, a table and a picture."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Cell = str | float | int | None


@dataclass(frozen=True)
class Table:
    """The numbers of a study.

    Attributes
    ----------
    columns
        Names, with units.
    rows
        One value a column; None where there is none.
    remarks
        Conditions, and what the thesis has to compare with.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    remarks: Mapping[str, str]

    def known(self) -> list[list[Cell]]:
        """Return the rows with None for what is not a number: JSON knows no NaN."""
        return [[None if isinstance(c, float) and isnan(c) else c for c in row] for row in self.rows]

    def as_json(self) -> dict[str, object]:
        """Return the table as plain values, one object a row."""
        rows = [dict(zip(self.columns, row, strict=True)) for row in self.known()]
        return {"rows": rows, "remarks": dict(self.remarks)}


@dataclass(frozen=True)
class Outcome:
    """What a study found: its numbers, and a picture of them."""

    table: Table
    picture: Figure


@dataclass(frozen=True)
class Study:
    """A study that anyone can run again.

    Attributes
    ----------
    name, summary
        As `sms study list` shows them.
    run
        Answers the question; takes a function that tells the person how far it is.
    """

    name: str
    summary: str
    run: Callable[[Callable[[str], None]], Outcome]


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, without a window and without global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def write(outcome: Outcome, study: Study, folder: Path) -> tuple[Path, Path, Path]:
    """Write a study into a folder; return its picture, its numbers with remarks, and its table as CSV."""
    folder.mkdir(parents=True, exist_ok=True)
    picture, numbers, table = (folder / f"{study.name}.{end}" for end in ("png", "json", "csv"))
    buffer = io.BytesIO()
    # Without the version of the program: the same picture has the same bytes.
    outcome.picture.savefig(buffer, format="png", metadata={"Software": None})
    picture.write_bytes(buffer.getvalue())
    text = json.dumps({"study": study.name, "summary": study.summary} | outcome.table.as_json(), indent=1)
    numbers.write_text(text + "\n", encoding="utf-8")
    with table.open("w", encoding="utf-8", newline="") as out:
        csv.writer(out).writerows([outcome.table.columns, *outcome.table.known()])
    return picture, numbers, table
