"""What a processor could do at most, measured, and what first-order matching asks of it, counted.

Williams, Waterman & Patterson 2009: work of F operations on B bytes takes no less than F / peak and no less
than B / bandwidth. The peak is that of fused multiplications and additions in double precision, two
operations each, at the widest vectors that the compiler gives to our kernels; the bandwidth is that of a copy
of what a subset's arrays hold, which is in the second level of the cache.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inlined, summing_kernel

_STEPS = 16
_CHAINS = 8  # that do not wait for each other: two instructions at a time, each of which takes four cycles

# Operations of a pixel; a fused multiplication and addition counts twice.
_PLACES = 10  # where it goes: 2 (2 + 2), and 2 for the part past a pixel
_WEIGHTS = 88  # of a quintic, along x and along y: 4 powers, 9 + 10 + 6 + 10 of polynomials, 5 of a rest
_TAPS = 78  # 6 rows of 6 products, 5 sums; 6 products, 5 sums of the rows; a factor
_DEFORMED_SUMS = 17  # of g, g^2, f g and six of J g
_PER_ITERATION = _PLACES + _WEIGHTS + _TAPS + _DEFORMED_SUMS
_ONCE = 3 * 12 + 2 * 11 + 7  # sums of J J^T by three, of J and J f by two, of f, f^2, dx^2, dy^2

# Numbers of eight bytes that a pixel needs.
_READ_AND_WRITTEN = 5 + 3 + 7 + 6  # places; s, t, value; coefficients that neighbours share; sums
_READ_ONCE = 9 + 3 * 4 + 2 * 4 + 3  # collected from the images; three, two and one pass of sums


@dataclass(frozen=True)
class Work:
    """Operations and bytes."""

    operations: float
    moved: float


def matching_work(pixels: float, iterations: float) -> Work:
    """Return the work of matching subsets to first order, of so many pixels and iterations altogether.

    `pixels` are those of all subsets, `iterations` are means. The loops are those of `subsets`, `spline`
    and `shape_functions`: collecting, finding runs and the normal equations are no operations here.
    """
    operations = pixels * (iterations * _PER_ITERATION + _ONCE)
    return Work(operations, 8.0 * pixels * (iterations * _READ_AND_WRITTEN + _READ_ONCE))


@inlined
def _chain(a: float, v: float) -> float:
    """Return what `_STEPS` multiplications and additions make of a number, one waiting for the other."""
    a = ((((a * v + 0.1) * v + 0.2) * v + 0.3) * v + 0.4) * v + 0.5
    a = ((((a * v + 0.6) * v + 0.7) * v + 0.8) * v + 0.9) * v + 1.1
    return (((((a * v + 1.2) * v + 1.3) * v + 1.4) * v + 1.5) * v + 1.6) * v + 1.7


@summing_kernel
def multiply_and_add(x: Floats, out: Floats) -> None:
    """Do nothing but fused multiplications and additions: `_CHAINS` x `_STEPS` an element."""
    for i in range(x.size):
        v = x[i]
        a, b = _chain(v + 0.1, v), _chain(v + 0.2, v)
        c, d = _chain(v + 0.3, v), _chain(v + 0.4, v)
        e, f = _chain(v + 0.5, v), _chain(v + 0.6, v)
        g, h = _chain(v + 0.7, v), _chain(v + 0.8, v)
        out[i] = ((a + b) + (c + d)) + ((e + f) + (g + h))


@summing_kernel
def copy_over(source: Floats, target: Floats, times: int) -> None:
    """Copy an array again and again, a little changed each time so that no copy is left out."""
    for turn in range(times):
        for i in range(source.size):
            target[i] = source[i] + turn


@dataclass(frozen=True)
class Peak:
    """Arrays on which a processor shows what it can do."""

    values: Floats
    out: Floats
    source: Floats
    target: Floats
    copies: int

    @classmethod
    def of(cls, elements: int, copied: int, copies: int) -> Peak:
        """Return room for so many elements of each."""
        values = np.linspace(0.1, 0.9, elements)
        return cls(values, np.empty(elements), np.linspace(0.0, 1.0, copied), np.empty(copied), copies)

    def calculate(self) -> None:
        """Do the operations."""
        multiply_and_add(self.values, self.out)

    def copy(self) -> None:
        """Move the bytes."""
        copy_over(self.source, self.target, self.copies)

    @property
    def work(self) -> Work:
        """Operations of `calculate`, and bytes that `copy` reads and writes."""
        return Work(2.0 * _CHAINS * _STEPS * self.values.size, 16.0 * self.source.size * self.copies)
