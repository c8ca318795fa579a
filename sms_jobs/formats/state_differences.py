"""By how much displacements differ at every state: maps, and rms over the states (thesis Fig. 72, 73)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sms_jobs.formats.figures import as_png, new_figure
from sms_jobs.metrology.arrays import Floats

_GOOD_PART = 0.95
_COLUMNS = (
    "state", "load_n", "applied_mm", "points", "rms_mm", "rms_of_best_95_percent_mm", "largest_mm",
    "stated_mm",
)  # fmt: skip


@dataclass(frozen=True)
class StateDifference:
    """What one state differs by.

    Attributes
    ----------
    state, load_n, applied_mm
        As they were measured, else as the campaign has them; None where they are not known.
    points, length
        (n, 3) and (n,) in mm: where, and the length of the difference there; known ones alone.
    stated_mm
        Rms of what is stated of the measured displacement.
    """

    state: str
    load_n: float | None
    applied_mm: float | None
    points: Floats
    length: Floats
    stated_mm: float

    @property
    def rms_mm(self) -> float:
        """Rms length over all points."""
        return float(np.sqrt(np.mean(self.length**2)))

    @property
    def good_rms_mm(self) -> float:
        """Rms length without the twentieth of the points that differ most: those at edges."""
        kept = self.length[self.length <= np.quantile(self.length, _GOOD_PART)]
        return float(np.sqrt(np.mean(kept**2)))

    def row(self) -> tuple[str | float | None, ...]:
        """Return the values of a row of the table."""
        rms = (self.rms_mm, self.good_rms_mm, float(self.length.max()), self.stated_mm)
        return (self.state, self.load_n, self.applied_mm, float(len(self.length)), *rms)

    def named(self) -> dict[str, str | float | None]:
        """Return the values of a row by name, with units in the names."""
        return dict(zip(_COLUMNS, self.row(), strict=True))


def written_table(states: Sequence[StateDifference]) -> bytes:
    """Return a table of all states as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows(["" if cell is None else cell for cell in one.row()] for one in states)
    return text.getvalue().encode()


def draw_states(states: Sequence[StateDifference], title: str) -> bytes:
    """Draw the difference's length at every state over x and y, and its rms over the states, as PNG."""
    figure = new_figure(max(2.6 * len(states), 6.0), 6.4)
    grid = figure.add_gridspec(2, len(states))
    largest = max(float(np.quantile(one.length, 0.99)) for one in states)
    maps = []
    for column, one in enumerate(states):
        axes = figure.add_subplot(grid[0, column])
        drawn = axes.scatter(
            one.points[:, 0], one.points[:, 1], c=one.length, s=1.0, vmin=0.0, vmax=largest, linewidths=0.0
        )
        axes.set_aspect("equal")
        axes.set_title(one.state, fontsize="medium")
        axes.tick_params(labelsize="x-small")
        maps.append(axes)
    figure.colorbar(drawn, ax=maps, label="difference [mm]")
    axes = figure.add_subplot(grid[1, :])
    place = np.arange(len(states))
    for label, values in (
        ("all points", [one.rms_mm for one in states]),
        ("the best 95 %", [one.good_rms_mm for one in states]),
        ("stated of the measured one", [one.stated_mm for one in states]),
    ):
        axes.plot(place, values, "o-", label=label)
    axes.set_xticks(place, [_loaded(one) for one in states])
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("rms [mm]")
    axes.legend(fontsize="small")
    figure.suptitle(title, fontsize="medium")
    return as_png(figure)


def _loaded(one: StateDifference) -> str:
    """Return a state's label, with its load where that is known."""
    return one.state if one.load_n is None else f"{one.state}\n{one.load_n / 1000.0:g} kN"
