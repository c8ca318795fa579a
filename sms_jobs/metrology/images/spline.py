"""Grey levels between pixels, by B-splines of third or fifth order.

The quintic's bias for speckle of a few pixels is several times smaller than the cubic's (thesis section
2.2.1 on interpolation bias); the cubic is the faster one and blurs noise less. The local cubic, which knows
4 x 4 pixels alone, is what other programs use: it is there to compare with them.
"""

from __future__ import annotations

from math import sqrt
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints
from sms_jobs.metrology.compilation import (
    inlined,
    inner,
    kernel,
    uncounted_kernel,
    uncounted_summing_kernel,
    variable,
)

Interpolant: TypeAlias = Literal["quintic", "cubic", "local-cubic"]
"""The quintic and cubic B-splines through an image, or cubic B-splines each through 4 x 4 pixels alone."""

KERNEL_CODE: Final[dict[Interpolant, int]] = {"local-cubic": 0, "cubic": 3, "quintic": 5}
"""What kernels know an interpolant by."""

PADDING = 8
"""Pixels by which spline coefficients are continued on every side, by reflection."""

_POLES: Final[dict[Interpolant, tuple[float, ...]]] = {
    "local-cubic": (),
    "cubic": (sqrt(3.0) - 2.0,),
    "quintic": (
        sqrt(67.5 - sqrt(17745.0 / 4.0)) + sqrt(26.25) - 6.5,
        sqrt(67.5 + sqrt(17745.0 / 4.0)) - sqrt(26.25) - 6.5,
    ),
}
"""Of the filters from grey levels to coefficients."""
_NOTHING = 1e-18  # of a grey level
_STRIP = 8  # columns of an image, or its rows turned: what lies beside each other is read at once
# Across and along: those of the local cubic are the grey level and its central difference of fourth order.
_VALUE_TAPS: Final[dict[Interpolant, Floats]] = {
    "local-cubic": np.ones(1),
    "cubic": np.array([1.0, 4.0, 1.0]) / 6.0,
    "quintic": np.array([1.0, 26.0, 66.0, 26.0, 1.0]) / 120.0,
}
_SLOPE_TAPS: Final[dict[Interpolant, Floats]] = {
    "local-cubic": np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0,
    "cubic": np.array([-1.0, 0.0, 1.0]) / 2.0,
    "quintic": np.array([-1.0, -10.0, 0.0, 10.0, 1.0]) / 24.0,
}
_STRETCH = 4  # pixels from which on a loop of its own is worth its start
_STRETCHED = 2  # columns by which the first coefficients of a stretch may be nearer or farther than a run's
_ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX, _SEVEN = (np.uint64(number) for number in range(1, 8))
_PER_14400 = 1.0 / 14400.0
_QUINTIC_TAPS = np.array(
    [
        [1.0, 26.0, 66.0, 26.0, 1.0, 0.0, 0.0, 0.0],
        [-5.0, -50.0, 0.0, 50.0, 5.0, 0.0, 0.0, 0.0],
        [10.0, 20.0, -60.0, 20.0, 10.0, 0.0, 0.0, 0.0],
        [-10.0, 20.0, 0.0, -20.0, 10.0, 0.0, 0.0, 0.0],
        [5.0, -20.0, 30.0, -20.0, 5.0, 0.0, 0.0, 0.0],
        [-1.0, 5.0, -10.0, 10.0, -5.0, 1.0, 0.0, 0.0],
    ]
)
"""120 times the weights of six coefficients at 0 <= a <= 1 past the third: row n has those of a^n."""
_LANES = 8  # points that one instruction may take


@inner
@uncounted_kernel
def _mirrored_sum(image: Floats, pole: float, column: int) -> float:
    """Return the sum of pole^k times the numbers of a column that is mirrored at both ends, for ever."""
    total, power = 0.0, 1.0
    for k in range(len(image)):
        total += power * image[k, column]
        power *= pole
        if abs(power) < _NOTHING:
            return float(total)
    for k in range(len(image) - 2, 0, -1):
        total += power * image[k, column]
        power *= pole
    return float(total / (1.0 - power))


@uncounted_summing_kernel
def _filter_columns(image: Floats, pole: float) -> None:
    """Filter the columns of an image in place by the recursions of a pole, down and up, some at a time."""
    rows, columns = image.shape
    if rows == 1:
        return
    gain = (1.0 - pole) * (1.0 - 1.0 / pole)
    for start in range(0, columns, _STRIP):
        stop = min(start + _STRIP, columns)
        for c in range(start, stop):
            image[0, c] = gain * _mirrored_sum(image, pole, c)
        for r in range(1, rows):
            for c in range(start, stop):
                image[r, c] = gain * image[r, c] + pole * image[r - 1, c]
        for c in range(start, stop):
            image[-1, c] = pole / (pole * pole - 1.0) * (image[-1, c] + pole * image[-2, c])
        for r in range(rows - 2, -1, -1):
            for c in range(start, stop):
                image[r, c] = pole * (image[r + 1, c] - image[r, c])


def spline_coefficients(image: NDArray[np.generic], interpolant: Interpolant = "quintic") -> Floats:
    """Return the coefficients of the B-spline through an image.

    Parameters
    ----------
    image
        (rows, columns), in grey levels.
    interpolant
        Those of the local cubic are the grey levels themselves.

    Returns
    -------
    (rows + 2 PADDING, columns + 2 PADDING), the spline being continued by reflection at its border.

    Notes
    -----
    The recursive filters of Unser, Aldroubi & Eden 1993, as SciPy has them, to and fro along each axis; here
    several lines at a time, since each number waits for the one before it: a fifth of SciPy's time.
    """
    # A part of an array has the same layout, turned or not: the filter is compiled but once.
    rows, columns = image.shape
    coefficients = np.empty((rows, columns + 1))[:, :columns]
    coefficients[:] = image
    for pole in _POLES[interpolant]:
        for lines in (coefficients, coefficients.T):
            _filter_columns(lines, pole)
    return np.pad(coefficients, PADDING, mode="reflect")


def spline_gradient(coefficients: Floats, interpolant: Interpolant = "quintic") -> tuple[Floats, Floats]:
    """Return the slopes of a B-spline at the pixels, along x and along y.

    Parameters
    ----------
    coefficients
        As `spline_coefficients` returns them, for an image of (rows, columns).
    interpolant
        The local cubic has a bend at the pixels; its slope there is the central difference of fourth order.

    Returns
    -------
    Two arrays (rows, columns), in grey levels a pixel.
    """
    value, slope = _VALUE_TAPS[interpolant], _SLOPE_TAPS[interpolant]
    import cv2

    along_x, along_y = (
        cv2.sepFilter2D(coefficients, -1, x, y)[PADDING:-PADDING, PADDING:-PADDING]
        for x, y in ((slope, value), (value, slope))
    )
    return np.ascontiguousarray(along_x), np.ascontiguousarray(along_y)


@inlined
def _quintic_weights(a: float) -> tuple[float, float, float, float, float, float]:
    """Return 120 times the weights of six coefficients at 0 <= a <= 1 past the third."""
    a2 = a * a
    a3 = a2 * a
    a4 = a2 * a2
    c5 = a4 * a
    c0 = 1.0 - 5.0 * a + 10.0 * a2 - 10.0 * a3 + 5.0 * a4 - c5
    c1 = 26.0 - 50.0 * a + 20.0 * a2 + 20.0 * a3 - 20.0 * a4 + 5.0 * c5
    c2 = 66.0 - 60.0 * a2 + 30.0 * a4 - 10.0 * c5
    c4 = 1.0 + 5.0 * a + 10.0 * a2 + 10.0 * a3 + 5.0 * a4 - 5.0 * c5
    return c0, c1, c2, 120.0 - c0 - c1 - c2 - c4 - c5, c4, c5


@inlined
def _six(
    flat: Floats, p: np.uint64, c0: float, c1: float, c2: float, c3: float, c4: float, c5: float
) -> float:
    """Return the sum of six coefficients in a row, each times its weight."""
    near: float = c0 * flat[p] + c1 * flat[p + _ONE] + c2 * flat[p + _TWO]
    far: float = c3 * flat[p + _THREE] + c4 * flat[p + _FOUR] + c5 * flat[p + _FIVE]
    return near + far


@inlined
def _quintic_run(
    flat: Floats, down: np.uint64, level: int, start: int, stop: int, s: Floats, t: Floats, values: Floats
) -> None:
    """Fill the values of a quintic at neighbours: point k is s, t past coefficient level + k + 2.

    That is the third of six rows. The taps are written out so that the compiler handles several points at a
    time; indices are unsigned so that no negative one needs a check.
    """
    ahead = np.uint64(level)
    for index in range(start, stop):
        k = np.uint64(index)
        p0 = k + ahead
        p1 = p0 + down
        p2 = p1 + down
        p3 = p2 + down
        p4 = p3 + down
        p5 = p4 + down
        c0, c1, c2, c3, c4, c5 = _quintic_weights(s[k])
        d0, d1, d2, d3, d4, d5 = _quintic_weights(t[k])
        total = d0 * _six(flat, p0, c0, c1, c2, c3, c4, c5)
        total += d1 * _six(flat, p1, c0, c1, c2, c3, c4, c5)
        total += d2 * _six(flat, p2, c0, c1, c2, c3, c4, c5)
        total += d3 * _six(flat, p3, c0, c1, c2, c3, c4, c5)
        total += d4 * _six(flat, p4, c0, c1, c2, c3, c4, c5)
        total += d5 * _six(flat, p5, c0, c1, c2, c3, c4, c5)
        values[k] = total * _PER_14400


@inlined
def _eight(
    flat: Floats, p: np.uint64,
    e0: float, e1: float, e2: float, e3: float, e4: float, e5: float, e6: float, e7: float,
) -> float:  # fmt: skip
    """Return the sum of eight coefficients in a row, each times its weight."""
    near: float = e0 * flat[p] + e1 * flat[p + _ONE] + e2 * flat[p + _TWO] + e3 * flat[p + _THREE]
    far: float = e4 * flat[p + _FOUR] + e5 * flat[p + _FIVE] + e6 * flat[p + _SIX] + e7 * flat[p + _SEVEN]
    return near + far


@inlined
def _quintic_stretch(
    flat: Floats, down: np.uint64, level: int, start: int, stop: int,
    first: Ints, s: Floats, t: Floats, values: Floats,
) -> None:  # fmt: skip
    """Fill the values of a quintic at near neighbours: point k has its first coefficient at k + level, or up
    to two further on.

    All points take eight columns, of which two have no weight: so several can be done at a time though what
    they need does not lie beside each other.
    """
    ahead = np.uint64(level)
    for index in range(start, stop):
        k = np.uint64(index)
        p0 = k + ahead
        p1 = p0 + down
        p2 = p1 + down
        p3 = p2 + down
        p4 = p3 + down
        p5 = p4 + down
        beyond = first[k] - index - level
        one, two = beyond == 1, beyond == 2
        c0, c1, c2, c3, c4, c5 = _quintic_weights(s[k])
        e0 = 0.0 if one | two else c0
        e1 = 0.0 if two else (c0 if one else c1)
        e2 = c0 if two else (c1 if one else c2)
        e3 = c1 if two else (c2 if one else c3)
        e4 = c2 if two else (c3 if one else c4)
        e5 = c3 if two else (c4 if one else c5)
        e6 = c4 if two else (c5 if one else 0.0)
        e7 = c5 if two else 0.0
        d0, d1, d2, d3, d4, d5 = _quintic_weights(t[k])
        total = d0 * _eight(flat, p0, e0, e1, e2, e3, e4, e5, e6, e7)
        total += d1 * _eight(flat, p1, e0, e1, e2, e3, e4, e5, e6, e7)
        total += d2 * _eight(flat, p2, e0, e1, e2, e3, e4, e5, e6, e7)
        total += d3 * _eight(flat, p3, e0, e1, e2, e3, e4, e5, e6, e7)
        total += d4 * _eight(flat, p4, e0, e1, e2, e3, e4, e5, e6, e7)
        total += d5 * _eight(flat, p5, e0, e1, e2, e3, e4, e5, e6, e7)
        values[k] = total * _PER_14400


@inner
@uncounted_summing_kernel
def _quintic_points(
    flat: Floats, columns: int, start: int, stop: int, taps: Floats,
    first: Ints, s: Floats, t: Floats, values: Floats,
) -> None:  # fmt: skip
    """Fill the values of a quintic at points anywhere, of each all columns of taps at a time.

    `taps` are `_QUINTIC_TAPS`: six weights and two zeros are what one instruction takes, where neighbours'
    coefficients would have to be gathered one by one. Indices are unsigned so that no negative one needs a
    check.
    """
    down = np.uint64(columns)
    for index in range(start, stop):
        k = np.uint64(index)
        a = s[k]
        d0, d1, d2, d3, d4, d5 = _quintic_weights(t[k])
        p0 = np.uint64(first[k])
        p1 = p0 + down
        p2 = p1 + down
        p3 = p2 + down
        p4 = p3 + down
        p5 = p4 + down
        total = 0.0
        # The last coefficients of all have none behind them.
        for column in range(min(taps.shape[1], flat.size - np.int64(p5))):
            i = np.uint64(column)
            c = taps[4, i] + a * taps[5, i]
            c = taps[0, i] + a * (taps[1, i] + a * (taps[2, i] + a * (taps[3, i] + a * c)))
            near = d0 * flat[p0 + i] + d1 * flat[p1 + i] + d2 * flat[p2 + i]
            far = d3 * flat[p3 + i] + d4 * flat[p4 + i] + d5 * flat[p5 + i]
            total += c * (near + far)
        values[k] = total * _PER_14400


@inner
@uncounted_kernel
def _cubic_taps(a: float, local: bool) -> tuple[float, float, float, float]:
    """Return six times the weights of four coefficients at 0 <= a <= 1 past the second, or of four pixels.

    The local cubic is the spline through its four pixels whose coefficients repeat beyond them: with B the
    matrix (5 1 0 0; 1 4 1 0; 0 1 4 1; 0 0 1 5) / 6 from coefficients to pixels, its weights are B^-1 c.
    """
    c0 = (1.0 - a) ** 3
    c1 = 4.0 - 6.0 * a * a + 3.0 * a**3
    c3 = a**3
    c2 = 6.0 - c0 - c1 - c3
    if not local:
        return c0, c1, c2, c3
    return (
        (71.0 * c0 - 19.0 * c1 + 5.0 * c2 - c3) / 56.0,
        (-19.0 * c0 + 95.0 * c1 - 25.0 * c2 + 5.0 * c3) / 56.0,
        (5.0 * c0 - 25.0 * c1 + 95.0 * c2 - 19.0 * c3) / 56.0,
        (-c0 + 5.0 * c1 - 19.0 * c2 + 71.0 * c3) / 56.0,
    )


@inner
@uncounted_summing_kernel
def _cubic_points(
    flat: Floats, columns: int, local: bool, count: int, first: Ints, s: Floats, t: Floats, values: Floats
) -> None:
    """Fill the values of a cubic at points anywhere, as `_quintic_points` does; `first` is the quintic's."""
    down = np.uint64(columns)
    for index in range(count):
        k = np.uint64(index)
        c0, c1, c2, c3 = _cubic_taps(s[k], local)
        d0, d1, d2, d3 = _cubic_taps(t[k], local)
        total = 0.0
        p0 = np.uint64(first[k]) + down + _ONE
        for c in (c0, c1, c2, c3):
            p1 = p0 + down
            p2 = p1 + down
            p3 = p2 + down
            total += c * (d0 * flat[p0] + d1 * flat[p1] + d2 * flat[p2] + d3 * flat[p3])
            p0 += _ONE
        values[k] = total / 36.0


@inlined
def _within(first: Ints, start: int, low: int, wide: int) -> int:
    """Return how many of the next points have their first coefficients `low` ahead or up to `wide` more."""
    count = 0
    for i in range(_LANES):
        beyond = first[np.uint64(start + i)] - start - i - low
        count += (beyond >= 0) & (beyond <= wide)
    return count


@inlined
def _reach(first: Ints, start: int) -> tuple[int, int, int]:
    """Return how many of the next points one loop can take, and the lowest and the highest level of these."""
    low = first[start] - start
    high = first[start + _LANES - 1] - (start + _LANES - 1)
    low, high = min(low, high), max(low, high)
    if high - low <= _STRETCHED and _within(first, start, low, high - low) == _LANES:
        return _LANES, low, high
    low = first[start] - start
    high = low
    stop = start + 1
    while stop < start + _LANES:
        level = first[stop] - stop
        lower, higher = min(low, level), max(high, level)
        if higher - lower > _STRETCHED:
            break
        low, high = lower, higher
        stop += 1
    return stop - start, low, high


@inner
@uncounted_summing_kernel
def _quintic_values(
    flat: Floats, columns: int, count: int, taps: Floats, first: Ints, s: Floats, t: Floats, values: Floats
) -> None:
    """Fill the values of a quintic, of eight points at a time where enough of these are near each other.

    The others of the eight are done again. `taps` are `_QUINTIC_TAPS`, from which the eight are taken: a loop
    of a constant length is written out, and none of it done at a time.
    """
    down, lanes = np.uint64(columns), taps.shape[1]
    last = flat.size - 5 * columns - 2 * _LANES  # the last place whose eight points have eight in each row
    scattered = variable(0)  # where the points begin that no eight has taken
    start = variable(0)
    while start + _LANES <= count:
        taken, low, high = _reach(first, start)
        if taken >= _STRETCH and start + low <= last:
            if scattered < start:
                _quintic_points(flat, columns, scattered, start, taps, first, s, t, values)
            if low == high:
                stop = start + lanes
                while taken >= _LANES and stop + _LANES <= count and _within(first, stop, low, 0) == _LANES:
                    stop += lanes
                _quintic_run(flat, down, low, start, stop, s, t, values)
                taken += stop - start - lanes
            else:
                _quintic_stretch(flat, down, low, start, start + lanes, first, s, t, values)
            scattered = start + taken
        start += taken
    _quintic_points(flat, columns, scattered, count, taps, first, s, t, values)


@kernel
def spline_values(
    coefficients: Floats, code: int, count: int, first: Ints, s: Floats, t: Floats, values: Floats
) -> None:
    """Fill `values[:count]` with the spline that kernels know by `code`.

    Point k lies s[k] columns and t[k] rows, 0 .. 1, past the coefficient two rows below and two columns right
    of number first[k] of `coefficients`, counted row by row. In images that are hardly turned most
    neighbours share their rows of coefficients: such go through loops that the compiler vectorises, and so do
    those of a subset that the deformed image shows wider or narrower by up to a quarter.
    """
    columns = coefficients.shape[1]
    flat = coefficients.ravel()
    if code != 5:
        _cubic_points(flat, columns, code == 0, count, first, s, t, values)
        return
    _quintic_values(flat, columns, count, _QUINTIC_TAPS, first, s, t, values)
