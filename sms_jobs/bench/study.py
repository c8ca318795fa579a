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

from sms_jobs.app.writing import check_new_file, new_folder, write_file
from sms_jobs.errors import InvalidInput

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sms_jobs.bench.published import Judged
    from sms_jobs.virtual_rig.campaigns import Size

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
    """What a study found: its numbers, a picture of them, and what they say to those of the thesis."""

    table: Table
    picture: Figure
    judged: Sequence[Judged] = ()

    def as_json(self) -> dict[str, object]:
        """Return it as plain values, one object a row."""
        found = self.table.as_json()
        if self.judged:
            from sms_jobs.bench.published import COLUMNS

            beside = Table(COLUMNS, [one.row() for one in self.judged], {})
            found["thesis"] = beside.as_json()["rows"]
        return found


@dataclass(frozen=True)
class Study:
    """A study that anyone can run again.

    Attributes
    ----------
    name, summary
        As `sms study list` shows them.
    run
        Answers the question; takes a function that tells the person how far it is.
    full
        The same with cameras of 1024 px instead of 512 px; None of a study of one size.
    """

    name: str
    summary: str
    run: Callable[[Callable[[str], None]], Outcome]
    full: Callable[[Callable[[str], None]], Outcome] | None = None

    def of_size(self, size: Size | None) -> Callable[[Callable[[str], None]], Outcome]:
        """Return what answers the question with cameras of a size; its own if none is given.

        Raises
        ------
        InvalidInput
            A study of one size is asked for another.
        """
        if size is None:
            return self.run
        if self.full is None:
            raise InvalidInput(f"study {self.name} has one size; leave --size out")
        return self.full if size == "full" else self.run


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, without a window and without global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def outputs(study: Study, folder: Path) -> tuple[Path, Path, Path]:
    """Return the files that a study writes into a folder, which is made: picture, numbers, table.

    Raises
    ------
    InvalidInput
        The folder cannot be made, or one of them cannot be written there.
    """
    new_folder(folder)
    picture, numbers, table = (folder / f"{study.name}.{end}" for end in ("png", "json", "csv"))
    for file in (picture, numbers, table):
        check_new_file(file, force=True)
    return picture, numbers, table


def write(outcome: Outcome, study: Study, folder: Path) -> tuple[Path, Path, Path]:
    """Write a study into a folder; return its picture, its numbers with remarks, and its table as CSV."""
    picture, numbers, table = outputs(study, folder)
    buffer = io.BytesIO()
    # Without the version of the program: the same picture has the same bytes.
    outcome.picture.savefig(buffer, format="png", metadata={"Software": None})
    write_file(picture, buffer.getvalue(), force=True)
    text = json.dumps({"study": study.name, "summary": study.summary} | outcome.as_json(), indent=1)
    write_file(numbers, text + "\n", force=True)
    rows = io.StringIO()
    csv.writer(rows).writerows([outcome.table.columns, *outcome.table.known()])
    write_file(table, rows.getvalue(), force=True)
    return picture, numbers, table
