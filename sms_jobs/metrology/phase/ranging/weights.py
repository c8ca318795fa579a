"""What the fits of a sequence weigh its densities with, and the sums of that."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import inner, kernel


class Weights(NamedTuple):
    """Weights over the densities t, 0 beyond the last density and where one is left out.

    Attributes
    ----------
    transfer, precision
        g, the modulation relative to that towards t = 0; w, 1 / variance of z(t) in units of that of a
        density with q steps, (padded,) each.
    search
        w g times the window, (padded,): what peaks are searched with.
    u
        w g t^k, k = 0 .. 2, (3, padded): what a signal is projected with.
    v
        w g^2 t^k, (3, padded): how returns overlap.
    """

    transfer: Singles
    precision: Singles
    search: Singles
    u: Singles
    v: Singles


class Sums(NamedTuple):
    """Sums of weights over the densities.

    `transfer`, `v` and `vtt` are those of the rows; `spread` is sum v t^4 - (sum v t^2)^2 / sum v, by which a
    fall of the amplitude with t is measured; `search` is Re H of a return of amplitude 1 at its peak, and
    `search_noise` the variance of Re H where z has a variance of 1.
    """

    transfer: float
    v: float
    vtt: float
    spread: float
    search: float
    search_noise: float


def fit_weights(
    densities: Floats, precision: Floats, transfer: Floats, window: Floats, padded: int
) -> Weights:
    """Return the weights of a sequence; arguments are (densities,), `padded` is the length of the rows."""
    weights, s = new_weights(padded), densities.size
    powers = densities ** np.arange(3)[:, None]
    weights.transfer[:s] = transfer
    weights.precision[:s] = precision
    weights.search[:s] = precision * transfer * window
    weights.u[:, :s] = precision * transfer * powers
    weights.v[:, :s] = precision * transfer**2 * powers
    return weights


@kernel
def new_weights(padded: int) -> Weights:
    """Return room for weights."""
    return Weights(
        np.zeros(padded, np.float32),
        np.zeros(padded, np.float32),
        np.zeros(padded, np.float32),
        np.zeros((3, padded), np.float32),
        np.zeros((3, padded), np.float32),
    )


@inner
@kernel
def leave_out(weights: Weights, lost: NDArray[np.uint8], kept: Weights) -> None:
    """Write to `kept` the weights without the densities that are not 0 in `lost`, (densities,)."""
    for t in range(lost.size):
        part = np.float32(0.0) if lost[t] else np.float32(1.0)
        kept.transfer[t] = part * weights.transfer[t]
        kept.precision[t] = part * weights.precision[t]
        kept.search[t] = part * weights.search[t]
        for k in range(3):
            kept.u[k, t] = part * weights.u[k, t]
            kept.v[k, t] = part * weights.v[k, t]


@kernel
def sums_of(weights: Weights, first: int) -> Sums:
    """Return the sums of weights whose first density is `first`."""
    transfer, v, vtt, vt4, search, search_noise = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(weights.transfer.size):
        t = float(first + i)
        transfer += weights.transfer[i]
        v += weights.v[0, i]
        vtt += weights.v[2, i]
        vt4 += weights.v[2, i] * t * t
        search += weights.search[i] * weights.transfer[i]
        if weights.precision[i] > 0.0:
            search_noise += weights.search[i] * weights.search[i] / weights.precision[i]
    return Sums(transfer, v, vtt, vt4 - vtt * vtt / v, search, search_noise)
