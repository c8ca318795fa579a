"""How close two returns may lie: success and precision over separation and amplitude ratio."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sms_jobs.bench.fringes.peeling import Peeled
from sms_jobs.bench.fringes.return_bounds import two_return_bound
from sms_jobs.bench.fringes.returns import Signals, found_near, pairs, rms, simulate, single_bound
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.metrology.phase.fourier_domain_ranging import Returns

FRINGES = 64
SIGNAL_TO_NOISE = 50.0
SEPARATIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)
RATIOS = (1.0, 0.5, 0.2, 0.1)
_PIXELS = 1 << 13

METHODS: dict[str, Callable[[Signals], Returns | Peeled]] = {
    "joint fit": lambda signals: signals.ranged(),
    "peel and refine (7.2.3)": lambda signals: signals.peeled(refinements=2),
}


def _measured(signals: Signals, found: Returns | Peeled) -> tuple[float, float]:
    """Return the part of pixels with both found, and the rms of the stronger there, in rad."""
    error, good = found_near(signals, found)
    return float(good.mean()), rms(error[0][good]) if good.any() else float("nan")


def run(say: Callable[[str], None]) -> Outcome:
    """Range two returns at many separations."""
    random = np.random.default_rng(8)
    unit = single_bound(FRINGES, SIGNAL_TO_NOISE)
    rows: list[tuple[Any, ...]] = []
    for ratio in RATIOS:
        say(f"amplitude ratio {ratio}")
        for apart in SEPARATIONS:
            omega = pairs(_PIXELS, (apart, apart), FRINGES, random)
            signals = simulate(omega, (1.0, ratio), FRINGES, SIGNAL_TO_NOISE, random)
            least = unit * two_return_bound(apart, FRINGES)
            found = [_measured(signals, method(signals)) for method in METHODS.values()]
            cells = [value for success, error in found for value in (success, error / least)]
            rows.append((ratio, apart, least / unit, *cells))
    names = [f"{m}: {what}" for m in METHODS for what in ("both found", "rms / bound")]
    columns = ("ratio", "apart, bins", "bound / that of one return", *names)
    remarks = {
        "conditions": f"s = {FRINGES}, q = 4, B / sigma = {SIGNAL_TO_NOISE:g} of the stronger, {_PIXELS} "
        "px a row, omega anywhere; found: each within a quarter bin of 2 pi / s, by a return of its own; "
        "rms of the stronger where both are found, which flatters a method that finds few",
        "thesis": "section 7.3.1 leaves a hinge region where the two peaks of |H| cannot be told apart: "
        "returns less than about two bins apart",
    }
    table = Table(columns, rows, remarks)
    return Outcome(table, _picture(rows))


def _picture(rows: list[tuple[Any, ...]]) -> Any:
    figure = new_figure(10.0, 4.5)
    success, precision = figure.subplots(1, 2)
    for number, ratio in enumerate(RATIOS):
        mine = np.array([row for row in rows if row[0] == ratio], dtype=np.float64)
        colour = f"C{number}"
        success.semilogx(mine[:, 1], mine[:, 3], "o-", color=colour, label=f"ratio {ratio:g}")
        success.semilogx(mine[:, 1], mine[:, 5], "x:", color=colour)
        precision.loglog(mine[:, 1], mine[:, 2], "-", color=colour, linewidth=1.0)
        precision.loglog(mine[:, 1], mine[:, 2] * mine[:, 4], "o", color=colour)
        precision.loglog(mine[:, 1], mine[:, 2] * mine[:, 6], "x", color=colour)
    success.set_ylabel("part of pixels with both returns found")
    precision.set_ylabel("rms of the stronger / bound of one return")
    for axes in (success, precision):
        axes.set_xlabel("separation [bins of 2 pi / s]")
    success.set_title("circles: joint fit, crosses: peel and refine", fontsize="medium")
    precision.set_title("lines: bound of two returns", fontsize="medium")
    success.legend(fontsize="small")
    return figure


STUDY = Study("two-returns", "two returns: success and precision over separation and amplitude ratio", run)
