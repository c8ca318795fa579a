"""The variance of what is known to whole steps only, as grey levels and their sums are.

The median of such values is itself a whole step, so that a variance from it jumps by as much. The second
moment does not: of a normal variable that is rounded at random it is the variance, with a twelfth of a
squared step from rounding (Sheppard 1898).
"""

from __future__ import annotations

from math import ceil, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

_CUT = 3.0  # standard deviations; beyond are motion and edges, with 0.3 % of the noise
_ROUNDS = 100
_SETTLED = 1e-5


def variance_of_rounded(values: NDArray[Any], step: float = 1.0) -> float:
    """Return the variance about 0 of normal numbers on the multiples of a step, whatever lies far outside.

    Parameters
    ----------
    values
        Any shape, at least one.
    step
        To whose next multiple the values are brought first.

    Returns
    -------
    In squared units of the values, with what rounding adds to the noise; 0 where most of them are 0.

    Notes
    -----
    The second moment within three standard deviations v^(1/2) is compared with that of the discrete law
    exp(-k^2 / (2 v)) cut off at the same multiple k, and v is corrected by their ratio until they agree:
    a cut makes no bias, wherever it falls between two multiples.
    """
    multiples = np.abs(np.rint(np.ravel(values) / step)).astype(np.int64)
    start = max(float(np.quantile(multiples, 0.6827)), 0.7)
    farthest = ceil(20.0 * start)
    counts = np.bincount(multiples[multiples <= farthest], minlength=farthest + 1)
    squares = np.arange(farthest + 1, dtype=np.float64) ** 2
    number, total = np.cumsum(counts), np.cumsum(counts * squares)
    v = start * start
    for _ in range(_ROUNDS):
        cut = min(ceil(_CUT * sqrt(v)), farthest)
        if total[cut] == 0.0:
            return 0.0
        law = np.exp(-squares[: cut + 1] / (2.0 * v))
        law[0] *= 0.5
        ratio = total[cut] / number[cut] * law.sum() / (law @ squares[: cut + 1])
        # The second moment of a narrow law goes by exp(-1 / (2 v)): whole corrections would overshoot.
        v *= ratio ** min(v, 1.0)
        if abs(ratio - 1.0) < _SETTLED:
            break
    return v * step * step
