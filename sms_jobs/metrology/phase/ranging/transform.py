"""Where the Fourier transform over the fringe densities is highest, for many pixels at once.

A chunk holds the signals of `LANES` pixels as (densities, LANES), so that every instruction of the
transform is a vector instruction over pixels.
"""

from __future__ import annotations

from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Singles
from sms_jobs.metrology.compilation import inner, summing_kernel

LANES = 64

_ROW = 2 * LANES  # of the transform: real part, imaginary part
_IMAGINARY = np.uint64(LANES)  # an unsigned index needs no look at its sign, which takes longer than a row
_NEXT = np.uint64(_ROW)


class Peaks(NamedTuple):
    """The transforms of `LANES` pixels and their highest samples.

    Attributes
    ----------
    spectrum
        Re H(k), (2 N, LANES).
    highest, place
        (LANES,): the highest sample and its k.
    omega, height
        (LANES,): where the peak is between the samples, in -pi .. pi, and how high.
    """

    spectrum: Singles
    highest: Singles
    place: NDArray[np.int32]
    omega: Floats
    height: Floats


class Transform(NamedTuple):
    """What a transform of length N looks up.

    Attributes
    ----------
    turns
        cos and sin of pi k / N, (2, N).
    order
        Where each input goes, (N,).
    butterflies
        The first of four rows, and how far they are apart, of every butterfly of two stages, (2, n).
    factors
        cos and sin of its twiddles in the first of its stages and in the second, (4, n).
    """

    turns: Singles
    order: Ints
    butterflies: Ints
    factors: Singles


@inner
@summing_kernel
def new_peaks(length: int) -> Peaks:
    """Return room for the peaks of transforms of a length N."""
    return Peaks(
        np.empty((2 * length, LANES), np.float32),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.int32),
        np.empty(LANES),
        np.empty(LANES),
    )


def transform_length(count: int) -> int:
    """Return N, the lowest power of two that is no less than the number of densities."""
    return 1 << (count - 1).bit_length()


def transform_of(length: int) -> Transform:
    """Return what a transform of a length N, a power of two from 4 on, looks up."""
    bits = length.bit_length() - 1
    angles = pi * np.arange(length) / length
    order = np.array([int(f"{i:0{bits}b}"[::-1], 2) for i in range(length)])
    half, rows, turns = 2 if bits % 2 else 4, [], []
    while half < length:
        for start in range(0, length, 4 * half):
            rows += [(start + k, half) for k in range(half)]
            turns += [(pi * k / half, pi * k / (2 * half)) for k in range(half)]
        half *= 4
    first, second = np.array(turns).reshape(-1, 2).T
    factors = np.stack([np.cos(first), np.sin(first), np.cos(second), np.sin(second)])
    return Transform(
        np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32),
        order,
        np.array(rows, np.int64).reshape(-1, 2).T.copy(),
        factors.astype(np.float32),
    )


@inner
@summing_kernel
def wrapped(angle: float) -> float:
    """Return an angle in -pi .. pi."""
    return float(angle - 2.0 * pi * np.rint(angle * (0.5 / pi)))


@inner
@summing_kernel
def _butterflies(rows: Singles, n: int) -> None:
    """Transform neighbouring rows: what a number of stages that is odd begins with."""
    for a in range(0, n, 2):
        row = np.uint64(a * _ROW)
        for j in range(LANES):
            i = row + np.uint64(j)
            k = i + _NEXT
            yr, yi, xr, xi = rows[i], rows[i + _IMAGINARY], rows[k], rows[k + _IMAGINARY]
            rows[i] = yr + xr
            rows[i + _IMAGINARY] = yi + xi
            rows[k] = yr - xr
            rows[k + _IMAGINARY] = yi - xi


@inner
@summing_kernel
def _first_stages(rows: Singles, n: int) -> None:
    """Transform every four rows, whose twiddles are 1 and -i."""
    for a in range(0, n, 4):
        row = np.uint64(a * _ROW)
        for j in range(LANES):
            i = row + np.uint64(j)
            k = i + _NEXT
            m = k + _NEXT
            o = m + _NEXT
            yr, yi, xr, xi = rows[i], rows[i + _IMAGINARY], rows[k], rows[k + _IMAGINARY]
            wr, wi, zr, zi = rows[m], rows[m + _IMAGINARY], rows[o], rows[o + _IMAGINARY]
            hr, hi, kr, ki = yr + xr, yi + xi, yr - xr, yi - xi
            fr, fi, gr, gi = wr + zr, wi + zi, wr - zr, wi - zi
            rows[i], rows[i + _IMAGINARY] = hr + fr, hi + fi
            rows[m], rows[m + _IMAGINARY] = hr - fr, hi - fi
            rows[k], rows[k + _IMAGINARY] = kr + gi, ki - gr
            rows[o], rows[o + _IMAGINARY] = kr - gi, ki + gr


@inner
@summing_kernel
def _transform(rows: Singles, n: int, butterflies: Ints, factors: Singles) -> None:
    """Transform n rows in place from bit-reversed order: H_k = sum z_m exp(-2 pi i k m / N).

    `rows` is flat, the imaginary part of each behind its real part: the compiler need not ask whether these
    overlap. Two stages at a time, so that every row is read and written half as often.
    """
    stages = 0
    while n >> stages > 1:
        stages += 1
    if stages % 2 == 1:
        _butterflies(rows, n)
    else:
        _first_stages(rows, n)
    for i in range(butterflies.shape[1]):
        row, step = np.uint64(butterflies[0, i] * _ROW), np.uint64(butterflies[1, i] * _ROW)
        c, s, p, q = factors[0, i], factors[1, i], factors[2, i], factors[3, i]
        for j in range(LANES):
            a = row + np.uint64(j)
            b = a + step
            d = b + step
            e = d + step
            yr, yi, wr, wi = rows[a], rows[a + _IMAGINARY], rows[d], rows[d + _IMAGINARY]
            xr, xi, zr, zi = rows[b], rows[b + _IMAGINARY], rows[e], rows[e + _IMAGINARY]
            xr, xi = c * xr + s * xi, c * xi - s * xr
            zr, zi = c * zr + s * zi, c * zi - s * zr
            # A twiddle that is a quarter turn further is this one with its parts exchanged.
            fr, fi = wr + zr, wi + zi
            gr, gi = wr - zr, wi - zi
            fr, fi = p * fr + q * fi, p * fi - q * fr
            gr, gi = p * gi - q * gr, -p * gr - q * gi
            hr, hi, kr, ki = yr + xr, yi + xi, yr - xr, yi - xi
            rows[a], rows[a + _IMAGINARY] = hr + fr, hi + fi
            rows[d], rows[d + _IMAGINARY] = hr - fr, hi - fi
            rows[b], rows[b + _IMAGINARY] = kr + gr, ki + gi
            rows[e], rows[e + _IMAGINARY] = kr - gr, ki - gi


@inner
@summing_kernel
def _combine(x: Singles, y: Singles, m: int, wx: float, wy: float, rows: Singles, place: int) -> None:
    """Add wx x_m + wy y_m to a place of the rows."""
    p, q = np.float32(wx), np.float32(wy)
    source, target = np.uint64(m * LANES), np.uint64(place)
    for j in range(LANES):
        n = np.uint64(j)
        rows[target + n] += p * x[source + n] + q * y[source + n]


@inner
@summing_kernel
def _combine_two(
    x: Singles,
    y: Singles,
    m: int,
    k: int,
    wm: float,
    wk: float,
    c: float,
    s: float,
    rows: Singles,
    i: int,
    o: int,
) -> None:
    """Write U_m to row i and U_(N-m) to row o from X_m and X_(N-m): see `find_peaks`.

    m, k are their rows of the signal, which is flat, wm, wk half their weights, c and s of pi m / N.
    """
    a, b, d = np.float32(wm * (1.0 + s)), np.float32(wm * (1.0 - s)), np.float32(wm * c)
    e, f, g = np.float32(wk * (1.0 + s)), np.float32(wk * (1.0 - s)), np.float32(wk * c)
    one, other = np.uint64(m * LANES), np.uint64(k * LANES)
    this, that = np.uint64(i * _ROW), np.uint64(o * _ROW)
    for j in range(LANES):
        n = np.uint64(j)
        p, q, r, t = x[one + n], y[one + n], x[other + n], y[other + n]
        rows[this + n] = (a * p - d * q) + (f * r - g * t)
        rows[this + n + _IMAGINARY] = (d * p + a * q) - (g * r + f * t)
        rows[that + n] = (b * p + d * q) + (e * r + g * t)
        rows[that + n + _IMAGINARY] = (d * p - b * q) + (e * t - g * r)


@inner
@summing_kernel
def _keep_highest(values: NDArray[np.int32], n: int, best: NDArray[np.int32]) -> None:
    """Keep the highest of 2 n rows, the bits of single floats, with its place in the lowest bits.

    Such bits order as the floats do where the highest is positive, and what the place overwrites is a part
    in 2^15 of the value: one integer maximum finds value and place.
    """
    keep, one = np.int32(-2 * n), np.int32(1)
    for place in range(0, 2 * n, 4):
        a = np.int32(place)
        b, c, d = np.int32(a + one), np.int32(a + one + one), np.int32(a + one + one + one)
        row = np.uint64(place * LANES)
        for j in range(LANES):
            i = row + np.uint64(j)
            low = max(np.int32((values[i] & keep) | a), np.int32((values[i + _IMAGINARY] & keep) | b))
            k = i + _NEXT
            high = max(np.int32((values[k] & keep) | c), np.int32((values[k + _IMAGINARY] & keep) | d))
            best[j] = max(best[j], max(low, high))


@inner
@summing_kernel
def _take_places(n: int, best: NDArray[np.int32], values: Singles, where: NDArray[np.int32]) -> None:
    """Split what `_keep_highest` kept into value and place."""
    bits = values.view(np.int32)
    for j in range(LANES):
        where[j] = best[j] & np.int32(2 * n - 1)
        bits[j] = best[j] & np.int32(-2 * n)


@inner
@summing_kernel
def _interpolate(peaks: Peaks) -> None:
    """Write omega and height of the peaks between their samples.

    A peak of Re H is a sin(u) / u sampled at u = pi apart, for which the neighbour's share is the offset.
    """
    place, highest, omega, height = peaks.place, peaks.highest, peaks.omega, peaks.height
    n, samples = peaks.spectrum.shape[0] // 2, peaks.spectrum.reshape(-1)
    # What is looked up is looked up first: the loop that computes with it is then vectorised.
    for j in range(LANES):
        k = place[j]
        before, after = (k - 1) & (2 * n - 1), (k + 1) & (2 * n - 1)  # n is a power of two
        # `_keep_highest` has put places into the last bits.
        highest[j] = samples[np.uint64(k * LANES + j)]
        omega[j] = samples[np.uint64(before * LANES + j)]
        height[j] = samples[np.uint64(after * LANES + j)]
    for j in range(LANES):
        here, left, right = highest[j], omega[j], height[j]
        beside = max(max(left, right), 0.0)
        offset = beside / (beside + here) if here > 0.0 else 0.0
        omega[j] = wrapped(pi / n * (place[j] + (offset if right > left else -offset)))
        u = pi * offset
        height[j] = here / (1.0 - u * u / 6.0 * (1.0 - u * u / 20.0))


@inner
@summing_kernel
def find_peaks(
    x: Singles,
    y: Singles,
    weights: Singles,
    first: int,
    transform: Transform,
    peaks: Peaks,
) -> None:
    """Find the highest Re H(k), k = 0 .. 2N-1, of every pixel, H(k) = sum w_t z_t exp(-i pi k t / N).

    Re H is band-limited: these 2 N real samples hold all of it. They are the real and imaginary parts of
    one complex transform of length N: with X_0 = 2 Re c_0, X_N = 2 Re c_N, X_m = c_m = w_m z_m else,
    U_m = [(X_m + X*_(N-m)) + i exp(-i pi m / N) (X_m - X*_(N-m))] / 2 becomes y_(2k) + i y_(2k+1).

    Parameters
    ----------
    x, y
        z(t), (densities or more, LANES).
    weights
        (densities or more,), 0 beyond the densities.
    first
        t of the first density.
    transform
        Of `transform_of`.
    peaks
        Of `new_peaks`; is written.
    """
    turns, order = transform.turns, transform.order
    n = order.size
    last = first + x.shape[0] - 1
    rows, flat_x, flat_y = peaks.spectrum.reshape(-1), x.reshape(-1), y.reshape(-1)
    for m in range(1, n // 2):
        k = n - m
        wm = 0.5 * weights[m - first] if first <= m <= last else 0.0
        wk = 0.5 * weights[k - first] if first <= k <= last else 0.0
        r, q = min(max(m, first), last) - first, min(max(k, first), last) - first
        _combine_two(flat_x, flat_y, r, q, wm, wk, turns[0, m], turns[1, m], rows, order[m], order[k])
    for m in (0, n // 2):
        rows[order[m] * _ROW : (order[m] + 1) * _ROW] = 0.0
    for m in (0, n // 2, n):
        if first <= m <= last:
            r, w = m - first, weights[m - first]
            real = order[m % n] * _ROW
            imaginary = real + LANES
            if m == n // 2:
                _combine(flat_x, flat_y, r, w, 0.0, rows, real)
                _combine(flat_x, flat_y, r, 0.0, w, rows, imaginary)
            else:
                _combine(flat_x, flat_y, r, w, 0.0, rows, real)
                _combine(flat_x, flat_y, r, w if m == 0 else -w, 0.0, rows, imaginary)
    _transform(rows, n, transform.butterflies, transform.factors)
    kept = np.full(LANES, np.iinfo(np.int32).min, np.int32)
    _keep_highest(rows.view(np.int32), n, kept)
    _take_places(n, kept, peaks.highest, peaks.place)
    _interpolate(peaks)
