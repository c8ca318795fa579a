"""Whether the phases of a recording tell of a scene that moved between its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from sms_jobs.metrology.arrays import Singles
from sms_jobs.metrology.phase.frame_fit import FrameFit

_KEPT = 0.999
_EXPLAINED = 0.6  # of the pixels
_LEAST_FREEDOM = 2
_PRICE = 0.02  # of the pixels that a drift, or a density that is left out, has to explain besides
_TINY = np.finfo(np.float32).tiny


@dataclass(frozen=True)
class PhaseJump:
    """Where in an orientation's recording the phase gradients change.

    Attributes
    ----------
    before, after
        Numbers of the last density before it and of the first one after it; those in between fit neither. The
        first and the last one for a drift all the while.
    change_rad
        Median change of the phase of the largest density.
    """

    before: int
    after: int
    change_rad: float


def find_jump(fit: FrameFit, densities: tuple[float, ...]) -> PhaseJump | None:
    """Find a jump, or a steady drift, that explains phases which do not belong to one gradient.

    Returns
    -------
    None where no motion explains more than 60 % of the pixels, or fewer than four densities leave no freedom
    to tell one.

    Notes
    -----
    Two gradients for the densities before and after, or one that changes steadily, are fitted to the
    residuals of each pixel; what is left has a chi-square law with two degrees of freedom less than there are
    densities, of which 99.9 % is kept. A density during which the jump happened is left out.
    """
    n = len(densities)
    t = np.array(densities, np.float32)[:, None]
    time = np.arange(n, dtype=np.float32)[:, None]
    tried: list[tuple[float, float, int, int, float]] = []
    for before in range(n - 1):
        for after in (before + 1, before + 2):
            freedom = before + 1 + n - after - 2
            if after >= n or freedom < _LEAST_FREEDOM:
                continue
            first, last = slice(0, before + 1), slice(after, n)
            left = np.zeros(fit.residual.shape[1], np.float32)
            change = np.zeros_like(left)
            for part, sign in ((first, -1.0), (last, 1.0)):
                r, w, own = fit.residual[part], fit.weight[part], t[part]
                slope = np.sum(w * own * r, axis=0) / np.maximum(np.sum(w * own * own, axis=0), _TINY)
                left += np.sum(w * np.square(r - own * slope), axis=0)
                change += np.float32(sign) * slope
            share = float(np.mean(left < chdtri(freedom, 1.0 - _KEPT)))
            skipped = _PRICE * (after - before - 1)
            tried.append((share - skipped, share, before, after, float(np.median(change))))
    if n - 2 >= _LEAST_FREEDOM:
        left, rate = _drifting(fit.residual, fit.weight, t, time - time.mean())
        share = float(np.mean(left < chdtri(n - 2, 1.0 - _KEPT)))
        tried.append((share - _PRICE, share, 0, n - 1, float(np.median(rate)) * (n - 1)))
    _, share, before, after, omega = max(tried, default=(0.0, 0.0, 0, 0, 0.0))
    return PhaseJump(before, after, omega * max(densities)) if share >= _EXPLAINED else None


def _drifting(residual: Singles, weight: Singles, t: Singles, time: Singles) -> tuple[Singles, Singles]:
    """Fit t (a + b time) to residuals (densities, pixels); return what is left, chi-square, and b."""
    u, v = t, t * time
    uu, uv, vv = (np.sum(weight * a * b, axis=0) for a, b in ((u, u), (u, v), (v, v)))
    ur, vr = (np.sum(weight * a * residual, axis=0) for a in (u, v))
    scale = np.maximum(uu * vv - uv * uv, _TINY)
    a, b = (vv * ur - uv * vr) / scale, (uu * vr - uv * ur) / scale
    return np.sum(weight * np.square(residual - u * a - v * b), axis=0), b
