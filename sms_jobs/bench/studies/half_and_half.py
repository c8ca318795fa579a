"""What regions are worth to a subset that two surfaces share, against how they share it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_jobs.bench.correlated.half_and_half import HALVES, AboutEdge, match_halves
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.metrology.deformation.matching.grid import Method

RADIUS = 16
NOISE = 0.025  # of the contrast
_WAYS: tuple[tuple[Method, bool, str], ...] = (
    ("gauss-newton", True, "regions"),
    ("gauss-newton", False, "plain"),
    ("fourier-newton", True, "thesis's peak, regions"),
    ("fourier-newton", False, "thesis's peak, plain"),
)


def by_distance(found: AboutEdge) -> tuple[np.ndarray, np.ndarray]:
    """Return the rms error in px and the part found, 0.5, 1.5 .. px from the edge, both sides together."""
    together = found.folded()
    return together.rms(), together.found()


def run(say: Callable[[str], None]) -> Outcome:
    """Match subsets across the edge by four ways."""
    figure = new_figure(9.5, 4.2)
    matched, against = figure.subplots(1, 2)
    columns = ["from the edge, px", "own part of the subset"]
    values: list[np.ndarray] = []
    for number, (method, parted, name) in enumerate(_WAYS):
        say(name)
        found = match_halves(parted=parted, method=method, radius=RADIUS, noise=NOISE)
        rms, part = by_distance(found)
        columns += [f"{name}: rms, px", "found"]
        values += [rms, part]
        half = len(found.distance) // 2
        if number == 0:
            values = [found.distance[half:], found.own_part[half:], *values]
        against.semilogy(found.distance[half:], rms, "o-", markersize=3, label=name)
        for side, row in ((0, half - 1), (1, half)):
            prescribed = found.shifts[:, side]
            with np.errstate(invalid="ignore"):
                mean = prescribed + np.nanmean(found.error[:, row], axis=1)
            label = name if side == 0 else None
            matched.plot(prescribed, mean, "o^"[side], color=f"C{number}", markersize=4, label=label)
    longest = HALVES[-1][1]
    matched.plot([0.0, longest], [0.0, longest], "k-", linewidth=0.5)
    matched.set_xlabel("prescribed displacement of the centre's half [px]")
    matched.set_ylabel("mean displacement found [px]")
    matched.set_title("half px from the edge; circles upper, triangles lower half", fontsize="small")
    matched.legend(fontsize="x-small")
    against.set_xlabel("distance of the subset's centre from the edge [px]")
    against.set_ylabel("rms error of u [px]")
    against.set_title(f"subset radius {RADIUS} px, noise {NOISE:.1%} of the contrast", fontsize="small")
    rows: list[tuple[Cell, ...]] = [tuple(float(v) for v in row) for row in zip(*values, strict=True)]
    remarks = {
        "conditions": f"exact speckle of blobs of 1.8 px, halves moved along x by {HALVES[0]} .. "
        f"{HALVES[-1]} px, noise of {NOISE:.1%} of the contrast in both images, radius {RADIUS} px, first "
        "order; guesses right to a pixel; rms of the matches that ended well",
        "thesis": "Fig. 37: 0.05 px with regions, on its own speckle",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study(
    "half-and-half", "subsets that two surfaces share, with regions and without (thesis Fig. 35-37)", run
)
