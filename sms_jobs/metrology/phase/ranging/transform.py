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
from sms_jobs.metrology.compilation import summing_kernel

LANES = 64


class Peaks(NamedTuple):
    """The transforms of `LANES` pixels and their highest samples.

    Attributes
    ----------
    spectrum
        Re H(k), (2, N, LANES): the samples with even k and those with odd k.
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


@summing_kernel
def new_peaks(length: int) -> Peaks:
    """Return room for the peaks of transforms of a length N."""
    return Peaks(
        np.empty((2, length, LANES), np.float32),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.int32),
        np.empty(LANES),
        np.empty(LANES),
    )


def transform_length(count: int) -> int:
    """Return N, the lowest power of two that is no less than the number of densities."""
    return 1 << (count - 1).bit_length()


def twiddles(length: int) -> Singles:
    """Return cos and sin of pi k / N, (2, 2 N)."""
    angles = pi * np.arange(2 * length) / length
    return np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)


def bit_reversal(length: int) -> Ints:
    """Return where each input of the transform goes, (N,)."""
    bits = length.bit_length() - 1
    return np.array([int(f"{i:0{bits}b}"[::-1], 2) if bits else 0 for i in range(length)])


@summing_kernel
def wrapped(angle: float) -> float:
    """Return an angle in -pi .. pi."""
    return float(angle - 2.0 * pi * np.rint(angle * (0.5 / pi)))


@summing_kernel
def _butterflies(re: Singles, im: Singles) -> None:
    """Transform neighbouring rows: what a number of stages that is odd begins with."""
    for a in range(0, re.shape[0], 2):
        for j in range(LANES):
            xr, xi, yr, yi = re[a + 1, j], im[a + 1, j], re[a, j], im[a, j]
            re[a, j] = yr + xr
            im[a, j] = yi + xi
            re[a + 1, j] = yr - xr
            im[a + 1, j] = yi - xi


@summing_kernel
def _transform(re: Singles, im: Singles, turns: Singles) -> None:
    """Transform (N, LANES) in place from bit-reversed order: H_k = sum z_m exp(-2 pi i k m / N).

    Two stages at a time, so that every row is read and written half as often. Rows are named by their number,
    not by slices: a slice costs more than a row of butterflies.
    """
    n = re.shape[0]
    half, stages = 1, 0
    while n >> stages > 1:
        stages += 1
    if stages % 2 == 1:
        _butterflies(re, im)
        half = 2
    while half < n:
        stride = n // (2 * half)  # pi k / N per twiddle of the second stage
        for start in range(0, n, 4 * half):
            for k in range(half):
                a, b = start + k, start + k + half
                d, e = b + half, b + 2 * half
                c, s = turns[0, 2 * k * stride], turns[1, 2 * k * stride]
                p, q = turns[0, k * stride], turns[1, k * stride]
                for j in range(LANES):
                    xr, xi = c * re[b, j] + s * im[b, j], c * im[b, j] - s * re[b, j]
                    yr, yi = re[a, j], im[a, j]
                    zr, zi = c * re[e, j] + s * im[e, j], c * im[e, j] - s * re[e, j]
                    wr, wi = re[d, j], im[d, j]
                    # A twiddle that is a quarter turn further is this one with its parts exchanged.
                    fr, fi = wr + zr, wi + zi
                    gr, gi = wr - zr, wi - zi
                    fr, fi = p * fr + q * fi, p * fi - q * fr
                    gr, gi = p * gi - q * gr, -p * gr - q * gi
                    hr, hi, kr, ki = yr + xr, yi + xi, yr - xr, yi - xi
                    re[a, j], im[a, j] = hr + fr, hi + fi
                    re[d, j], im[d, j] = hr - fr, hi - fi
                    re[b, j], im[b, j] = kr + gr, ki + gi
                    re[e, j], im[e, j] = kr - gr, ki - gi
        half *= 4


@summing_kernel
def _combine(x: Singles, y: Singles, m: int, wx: float, wy: float, out: Singles, i: int) -> None:
    """Add wx x_m + wy y_m to a row."""
    p, q = np.float32(wx), np.float32(wy)
    for j in range(LANES):
        out[i, j] += p * x[m, j] + q * y[m, j]


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
    re: Singles,
    im: Singles,
    i: int,
    o: int,
) -> None:
    """Write U_m to row i and U_(N-m) to row o from X_m and X_(N-m): see `real_peaks`.

    m, k are their rows of the signal, wm, wk half their weights, c and s of pi m / N.
    """
    a, b, d = np.float32(wm * (1.0 + s)), np.float32(wm * (1.0 - s)), np.float32(wm * c)
    e, f, g = np.float32(wk * (1.0 + s)), np.float32(wk * (1.0 - s)), np.float32(wk * c)
    for j in range(LANES):
        p, q, r, t = x[m, j], y[m, j], x[k, j], y[k, j]
        re[i, j] = (a * p - d * q) + (f * r - g * t)
        im[i, j] = (d * p + a * q) - (g * r + f * t)
        re[o, j] = (b * p + d * q) + (e * r + g * t)
        im[o, j] = (d * p - b * q) + (e * t - g * r)


@summing_kernel
def _keep_highest(values: NDArray[np.int32], interleave: int, offset: int, best: NDArray[np.int32]) -> None:
    """Keep the highest of the rows, the bits of single floats, with its place in the lowest bits.

    Such bits order as the floats do where the highest is positive, and what the place overwrites is a part
    in 2^15 of the value: one integer maximum finds value and place.
    """
    n = values.shape[0]
    keep = np.int32(-2 * n)
    step = np.int32(interleave)
    for k in range(0, n - n % 2, 2):
        a = np.int32(interleave * k + offset)
        b = a + step
        for j in range(LANES):
            best[j] = max(best[j], max((values[k, j] & keep) | a, (values[k + 1, j] & keep) | b))


@summing_kernel
def _take_places(n: int, best: NDArray[np.int32], values: Singles, where: NDArray[np.int32]) -> None:
    """Split what `_keep_highest` kept into value and place."""
    bits = values.view(np.int32)
    for j in range(LANES):
        where[j] = best[j] & np.int32(2 * n - 1)
        bits[j] = best[j] & np.int32(-2 * n)


@summing_kernel
def _interpolate(peaks: Peaks) -> None:
    """Write omega and height of the peaks between their samples.

    A peak of Re H is a sin(u) / u sampled at u = pi apart, for which the neighbour's share is the offset.
    """
    place, highest, omega, height = peaks.place, peaks.highest, peaks.omega, peaks.height
    n, samples = peaks.spectrum.shape[1], peaks.spectrum.reshape(-1)
    # What is looked up is looked up first: the loop that computes with it is then vectorised.
    for j in range(LANES):
        k = place[j]
        before, after = (k - 1) & (2 * n - 1), (k + 1) & (2 * n - 1)  # n is a power of two
        # `_keep_highest` has put places into the last bits.
        highest[j] = samples[np.uint64(((k & 1) * n + (k >> 1)) * LANES + j)]
        omega[j] = samples[np.uint64(((before & 1) * n + (before >> 1)) * LANES + j)]
        height[j] = samples[np.uint64(((after & 1) * n + (after >> 1)) * LANES + j)]
    for j in range(LANES):
        here, left, right = highest[j], omega[j], height[j]
        beside = max(max(left, right), 0.0)
        offset = beside / (beside + here) if here > 0.0 else 0.0
        omega[j] = wrapped(pi / n * (place[j] + (offset if right > left else -offset)))
        u = pi * offset
        height[j] = here / (1.0 - u * u / 6.0 * (1.0 - u * u / 20.0))


@summing_kernel
def find_peaks(
    x: Singles,
    y: Singles,
    weights: Singles,
    first: int,
    turns: Singles,
    order: Ints,
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
    turns, order
        Of `twiddles` and `bit_reversal`.
    peaks
        Of `new_peaks`; is written.
    """
    n = order.size
    last = first + x.shape[0] - 1
    re, im = peaks.spectrum[0], peaks.spectrum[1]
    for m in range(1, n // 2):
        k = n - m
        wm = 0.5 * weights[m - first] if first <= m <= last else 0.0
        wk = 0.5 * weights[k - first] if first <= k <= last else 0.0
        r, q = min(max(m, first), last) - first, min(max(k, first), last) - first
        _combine_two(x, y, r, q, wm, wk, turns[0, m], turns[1, m], re, im, order[m], order[k])
    for m in (0, n // 2):
        re[order[m]] = 0.0
        im[order[m]] = 0.0
    for m in (0, n // 2, n):
        if first <= m <= last:
            r, w = m - first, weights[m - first]
            i = order[m % n]
            if m == n // 2:
                _combine(x, y, r, w, 0.0, re, i)
                _combine(x, y, r, 0.0, w, im, i)
            else:
                _combine(x, y, r, w, 0.0, re, i)
                _combine(x, y, r, w if m == 0 else -w, 0.0, im, i)
    _transform(re, im, turns)
    kept = np.full(LANES, np.iinfo(np.int32).min, np.int32)
    _keep_highest(re.view(np.int32), 2, 0, kept)
    _keep_highest(im.view(np.int32), 2, 1, kept)
    _take_places(n, kept, peaks.highest, peaks.place)
    _interpolate(peaks)
