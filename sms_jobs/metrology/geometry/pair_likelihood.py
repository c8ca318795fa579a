"""How likely a combination of returns is light straight from the projector: see `ray_pairing`."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from sms_jobs.metrology.arrays import Floats, Ints, Singles
from sms_jobs.metrology.compilation import inner, kernel
from sms_jobs.metrology.geometry.lens_kernels import undistorted
from sms_jobs.metrology.geometry.triangulation import closest, closest_change, turned

Vector: TypeAlias = tuple[float, float, float]
Settings: TypeAlias = tuple[float, float, float, float, float, float, bool, float]
"""Gap of the calibration, rms density, tolerance and largest chi-square of amplitudes, penalty outside the
volume, standard deviations of one place, whether the plain rule is to choose, width of a peak."""
Pair: TypeAlias = tuple[Floats, Floats, Floats, Floats, Floats]
"""Of `packed`, and the (orientations, 2) matrix from pixels to omega."""


class Combination(NamedTuple):
    """One return of each orientation: omega, its deviation and its strength; room for eight numbers."""

    omega: Floats
    sigma: Floats
    strength: Floats
    inner: Floats


@inner
@kernel
def new_combination(orientations: int) -> Combination:
    """Return room for a combination."""
    return Combination(np.empty(orientations), np.empty(orientations), np.empty(orientations), np.empty(8))


@inner
@kernel
def split(combination: int, counts: Ints, which: Ints) -> None:
    """Turn the number of a combination into a return of each orientation, the last counting fastest."""
    for k in range(counts.size - 1, -1, -1):
        which[k] = combination % counts[k]
        combination //= counts[k]


@inner
@kernel
def take(
    omega: Floats, sigma: Singles, amplitude: Singles, which: Ints, place: tuple[int, int], one: Combination
) -> None:
    """Take some returns of the pixel at (row, column)."""
    row, column = place
    for k in range(which.size):
        one.omega[k] = omega[k, which[k], row, column]
        one.sigma[k] = sigma[k, which[k], row, column]
        one.strength[k] = amplitude[k, which[k], row, column]


@inner
@kernel
def take_spread(
    omega: Floats,
    sigma: Singles,
    amplitude: Singles,
    counts: Ints,
    place: tuple[int, int],
    peak: float,
    one: Combination,
) -> bool:
    """Take what a pixel's returns are if each orientation has one that is spread; tell whether they may be.

    Its omega is the mean by amplitude. Errors of sharp returns that fit it go against each other: its own
    is no larger than that of the better of them, in parts of the amplitudes.
    """
    row, column = place
    for k in range(counts.size):
        low, high, mean, total, least = np.inf, -np.inf, 0.0, 0.0, np.inf
        for i in range(counts[k]):
            value, weight = omega[k, i, row, column], np.float64(amplitude[k, i, row, column])
            low, high = min(low, value), max(high, value)
            mean += weight * value
            total += weight
            least = min(least, weight * sigma[k, i, row, column])
        if high - low > peak:
            return False
        one.omega[k], one.sigma[k], one.strength[k] = mean / total, least / total, total
    return True


@inner
@kernel
def _disagreement(strength: Floats, sigma: Floats, density_rms: float, tolerance: float) -> float:
    """Return the chi-square of the logarithms of a combination's amplitudes about their weighted mean."""
    weight_sum, mean, square = 0.0, 0.0, 0.0
    for k in range(strength.size):
        spread = density_rms * sigma[k]
        weight = 1.0 / (tolerance * tolerance + spread * spread)
        logarithm = np.log(max(strength[k], 1e-6))
        weight_sum += weight
        mean += weight * logarithm
        square += weight * logarithm * logarithm
    return max(square - mean * mean / weight_sum, 0.0)


@inner
@kernel
def weigh(
    u: Vector,
    one: Combination,
    pair: Pair,
    box: Floats,
    settings: Settings,
) -> tuple[float, float, float, float]:
    """Return log-likelihood, gap in mm, and depth along the camera's ray u with its variance.

    The likelihood of rays that do not meet is -infinity.
    """
    omega, sigma, strength, inner = one
    centres, lens, to_pixel, turn, to_omega = pair
    base = (centres[1, 0] - centres[0, 0], centres[1, 1] - centres[0, 1], centres[1, 2] - centres[0, 2])
    x, y = 0.0, 0.0
    for k in range(omega.size):
        x += to_pixel[0, k] * omega[k]
        y += to_pixel[1, k] * omega[k]
    inner[0], inner[1] = centres[2, 0] + x, centres[2, 1] + y
    if not undistorted(lens, inner[:2], inner[2:]):
        return -np.inf, np.inf, np.nan, np.nan
    v = turned(turn, inner[2], inner[3], 1.0)
    point, gap = closest(u, v, base, 0.0)
    if not np.isfinite(gap):
        return -np.inf, np.inf, np.nan, np.nan
    odd = _disagreement(strength, sigma, settings[1], settings[2])
    variance, deep, evidence = settings[0] * settings[0], 0.0, min(odd, settings[3])
    for k in range(omega.size):
        px, py = to_pixel[0, k], to_pixel[1, k]
        dv = turned(turn, inner[4] * px + inner[5] * py, inner[6] * px + inner[7] * py, 0.0)
        moved, opened = closest_change(u, v, base, 0.0, dv)
        along = moved[0] * u[0] + moved[1] * u[1] + moved[2] * u[2]
        noise = sigma[k] * sigma[k]
        variance += opened * opened * noise
        deep += along * along * noise
        off = to_omega[k, 0] * x + to_omega[k, 1] * y - omega[k]
        evidence += off * off / noise
    likelihood = -0.5 * (evidence + gap * gap / variance + np.log(variance))
    for i in range(3):
        place = centres[0, i] + point[i]
        if place < box[0, i] or place > box[1, i]:
            likelihood -= settings[4]
            break
    return likelihood, gap, point[0] * u[0] + point[1] * u[1] + point[2] * u[2], deep


@inner
@kernel
def runner_up(
    best: int, likelihood: Floats, depth: Floats, variance: Floats, count: int, one_place: float
) -> float:
    """Return the largest log-likelihood of a combination whose point is not that of the best."""
    second = -np.inf
    for c in range(count):
        near = one_place * np.sqrt(variance[c] + variance[best])
        if c != best and not abs(depth[c] - depth[best]) <= near:
            second = max(second, likelihood[c])
    return second
