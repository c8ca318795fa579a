"""Table 6 of the thesis: one return at kappa = 3.3 with noise of 0.01, found by every method."""

from __future__ import annotations

from collections.abc import Callable
from math import pi

import numpy as np

from sms_jobs.bench.figures import cpu_seconds
from sms_jobs.bench.fringes.returns import Signals, simulate, single_bound
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.metrology.arrays import Floats

FRINGES = 64
KAPPA = 3.3
NOISE = 0.01  # of the mean level, and so of the modulation
_PIXELS = 1 << 15


def _methods(signals: Signals) -> dict[str, Callable[[], Floats]]:
    """Return what finds omega, by the method's name."""
    return {
        "temporal unwrapping, least squares over t = 1 .. 63": lambda: signals.unwrapped().omega,
        "FDR, original: maximum of |H| (7.2.1)": lambda: signals.peeled(interpolated=False).omega[0],
        "FDR, improved: interpolated start (7.2.2)": lambda: signals.peeled().omega[0],
        "FDR, known origin: maximum of Re H": lambda: signals.ranged().omega[0],
    }


def run(say: Callable[[str], None]) -> Outcome:
    """Find omega by every method, in many pixels that differ in their noise."""
    true = 2.0 * pi * KAPPA / FRINGES
    random = np.random.default_rng(6)
    omega = np.full((1, _PIXELS), true)
    signals = simulate(omega, (1.0,), FRINGES, 1.0 / NOISE, random, law="uniform")
    bound = single_bound(FRINGES, 1.0 / NOISE)
    rows: list[tuple[str | float, ...]] = []
    figure = new_figure(8.0, 4.5)
    axes = figure.add_subplot()
    for name, method in _methods(signals).items():
        say(name)
        error = method().ravel() - true
        deviation = float(np.std(error))
        seconds = cpu_seconds(method) / _PIXELS
        bias = float(np.mean(error))
        rows.append((name, true + bias, bias * 1e5, deviation * 1e5, deviation / bound, seconds * 1e6))
        axes.hist(error * 1e5, bins=120, range=(-12.0, 12.0), histtype="step", density=True, label=name)
    axes.set_xlabel("error of omega [10⁻⁵ rad]")
    axes.set_ylabel("probability density")
    axes.set_title(f"one return, kappa = {KAPPA}, s = {FRINGES}, noise {NOISE}", fontsize="medium")
    axes.legend(fontsize="x-small")
    columns = ("method", "mean, rad", "bias, 1e-5 rad", "std, 1e-5 rad", "std / bound", "CPU time, us / px")
    remarks = {
        "conditions": f"s = {FRINGES}, q = 4, kappa = {KAPPA}, true omega {true:.6f} rad, uniform noise of "
        f"standard deviation {NOISE} of the modulation, {_PIXELS} px, one thread",
        "bound": f"known origin: {bound * 1e5:.3f}e-5 rad; |H|: twice that",
        "thesis": "its text says that the improved method is the best of the three that it compares; the "
        "figures of its Table 6 have not survived in the text at hand",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study("table-6", "one return, every method: mean, standard deviation, time (thesis Table 6)", run)
