"""How close ranging comes to the least error that theory allows, over s and the signal to noise ratio."""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np

from sms_jobs.bench.fringes.returns import rms, simulate, single_bound, wrapped
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.metrology.arrays import Floats

FRINGES = (8, 16, 32, 64, 128)
SIGNAL_TO_NOISE = (5.0, 20.0, 50.0, 200.0)
_PIXELS = 1 << 14


def _rms(error: Floats) -> float:
    return rms(error[np.isfinite(error)])


def run(say: Callable[[str], None]) -> Outcome:
    """Find omega of one return anywhere in the projector's image."""
    random = np.random.default_rng(7)
    rows: list[tuple[float | None, ...]] = []
    figure = new_figure(8.0, 5.0)
    axes = figure.add_subplot()
    for number, ratio in enumerate(SIGNAL_TO_NOISE):
        errors = []
        for fringes in FRINGES:
            say(f"s = {fringes}, B / sigma = {ratio:g}")
            signals = simulate(random.uniform(-pi, pi, (1, _PIXELS)), (1.0,), fringes, ratio, random)
            bound = single_bound(fringes, ratio)
            found = signals.ranged()
            known = wrapped(found.omega[0].ravel() - signals.omega[0])
            modulus = wrapped(signals.peeled().omega[0].ravel() - signals.omega[0])
            unwrapped = wrapped(signals.unwrapped().omega.ravel() - signals.omega[0])
            stated = float(np.sqrt(np.nanmean(np.square(found.omega_sigma[0], dtype=np.float64))))
            errors.append(_rms(known))
            rows.append(
                (
                    fringes,
                    ratio,
                    bound * 1e6,
                    _rms(known) / bound,
                    float(np.nanmean(known)) / bound,
                    stated / bound,
                    _rms(modulus) / bound,
                    _rms(unwrapped) / bound,
                )
            )
        colour = f"C{number}"
        axes.loglog(FRINGES, errors, "o", color=colour, label=f"B / sigma = {ratio:g}")
        axes.loglog(FRINGES, [single_bound(s, ratio) for s in FRINGES], "-", color=colour, linewidth=1.0)
    axes.set_xlabel("number of fringes s")
    axes.set_ylabel("rms error of omega [rad]")
    axes.set_title(
        "one return: points measured, lines the bound sigma / (B sqrt(2 sum t²))", fontsize="medium"
    )
    axes.set_xticks(FRINGES, [str(s) for s in FRINGES])
    axes.minorticks_off()
    axes.legend(fontsize="small")
    columns = (
        "s",
        "B / sigma",
        "bound, 1e-6 rad",
        "known origin: rms / bound",
        "bias / bound",
        "stated sigma / bound",
        "|H| (7.2.2): rms / bound",
        "unwrapping: rms / bound",
    )
    remarks = {
        "conditions": f"q = 4, densities 0 .. s-1, omega anywhere in -pi .. pi, {_PIXELS} px a row, of those "
        "in which a return was found; unwrapping of the densities 1 .. s-1",
        "thesis": "section 7.2.1: errors fall as s^-1.5; so does the bound, and |H| stays at twice of it",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study("ranging-bound", "rms error of one return against the theoretical bound, over s and noise", run)
