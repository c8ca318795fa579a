"""Whether the lenses are still those that the calibration which an adjustment starts from knew."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.parameters import Freedom, State
from sms_jobs.metrology.calibration.bundle.problem import BundleProblem
from sms_jobs.metrology.geometry.camera import PER_POSE, PER_SENSOR, SENSOR_PARAMETERS

_CHANCE = 6e-5
"""Of warning of lenses that are as they were: that of four standard deviations, as of certified lengths."""

_LEAST_TOLD = 0.01
"""Of the variance known before: along directions of which observations tell less, a lens stays as it was."""


def changed_lenses(
    problem: BundleProblem, state: State, freedom: Freedom, covariance: Floats, added: Floats | None
) -> tuple[str, ...]:
    """Warn of lenses that the observations have elsewhere than what was known before, beyond chance.

    Lenses that are as they were move by what has the covariance P - C, with P known before and C after, and
    by what points of boards that are printed off do to them.

    Parameters
    ----------
    covariance
        Of all parameters, with that of the points.
    added
        (u, u) what the points add to that of the free parameters.
    """
    if problem.prior is None:
        return ()
    information = problem.prior.information
    known = np.flatnonzero(np.diag(information) > 0.0)
    lens = (known % PER_SENSOR >= PER_POSE) & freedom.free[known]
    at = known[lens]
    if not len(at):
        return ()
    before = np.asarray(np.linalg.inv(information[np.ix_(known, known)])[np.ix_(lens, lens)], np.float64)
    gained = before - covariance[np.ix_(at, at)]
    if added is not None:
        gained += 2.0 * freedom.unfold_covariance(added)[np.ix_(at, at)]
    start = np.array([s.intrinsics.vector() for s in problem.sensors])
    off = (state.lens - start)[at // PER_SENSOR, at % PER_SENSOR - PER_POSE]
    square, count = _chi_square(off, before, gained)
    if not count or square <= (limit := float(chdtri(count, _CHANCE))):
        return ()
    deviations = off / np.sqrt(np.maximum(np.diag(gained), _LEAST_TOLD * np.diag(before)))
    worst = int(np.argmax(np.abs(deviations)))
    what = f"{SENSOR_PARAMETERS[at[worst] % PER_SENSOR]} of {problem.sensors[at[worst] // PER_SENSOR].name}"
    told = (
        f"the lenses are not those of the calibration that this one starts from: {what} moves by "
        f"{off[worst]:+.3g}, {abs(deviations[worst]):.1f} of its deviations (chi-square of all {square:.0f}, "
        f"limit {limit:.0f}), and what is found is a mean of both, worse than stated: was a lens refocused "
        'or exchanged? Then calibrate from nothing (starts_from = "nothing")'
    )
    return (told,)


def _chi_square(off: Floats, before: Floats, gained: Floats) -> tuple[float, int]:
    """Return the sum of squares of what lenses moved by, in deviations, and along how many directions."""
    root = np.linalg.cholesky(before)
    half = np.linalg.solve(root, gained)
    parts, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    along = vectors.T @ np.linalg.solve(root, off)
    told = parts > _LEAST_TOLD
    return float(np.sum(along[told] ** 2 / parts[told])), int(told.sum())
