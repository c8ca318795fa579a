"""Symmetric positive definite systems of up to some hundred unknowns, in one thread.

Libraries spread such small matrices over all cores, where they wait for each other as soon as anybody else
works. With 210 unknowns on a busy machine of two cores, SciPy's `cho_factor` and `cho_solve` take seven times
the CPU time of these kernels; kept to one thread from outside, 0.8 to 0.9 of it. Kernels call `factorise` and
`back_substitute` too, which compile faster than Numba's `numpy.linalg`.
"""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import uncounted_summing_kernel


@uncounted_summing_kernel
def factorise(a: Floats) -> bool:
    """Replace the lower triangle by its Cholesky factor; say whether the matrix was positive definite."""
    n = len(a)
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i != j:
                a[i, j] = total / a[j, j]
            elif total > 0.0:
                a[i, i] = np.sqrt(total)
            else:
                return False
    return True


@uncounted_summing_kernel
def back_substitute(factor: Floats, x: Floats) -> None:
    """Replace x (n,) by the solution of L L^T y = x."""
    n = len(x)
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= factor[i, k] * x[k]
        x[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        x[i] /= factor[i, i]
        for k in range(i):
            x[k] -= factor[i, k] * x[i]


@uncounted_summing_kernel
def _inverse(factor: Floats, lower: Floats, result: Floats) -> None:
    """Fill result (n, n) with (L L^T)^-1, by way of lower = L^-1; both are zero before."""
    n = len(factor)
    for i in range(n):
        lower[i, i] = 1.0 / factor[i, i]
        for k in range(i):
            by = -factor[i, k] / factor[i, i]
            for j in range(k + 1):
                lower[i, j] += by * lower[k, j]
    for k in range(n):
        for i in range(k + 1):
            by = lower[k, i]
            for j in range(i + 1):
                result[i, j] += by * lower[k, j]
    for i in range(n):
        for j in range(i):
            result[j, i] = result[i, j]


def _scaled(matrix: Floats) -> tuple[Floats, Floats]:
    """Return a matrix with the diagonal brought to 1, and what its rows were multiplied by."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    return np.ascontiguousarray(matrix * np.outer(size, size)), size


def solve(matrix: Floats, vector: Floats, damping: float) -> Floats:
    """Return the solution of a system whose scaled diagonal is raised by `damping`, more if it must be."""
    scaled, size = _scaled(matrix)
    while True:
        factor = scaled + damping * np.eye(len(scaled))
        if factorise(factor):
            break
        damping = max(100.0 * damping, 1e-12)
    found = size * vector
    back_substitute(factor, found)
    return np.asarray(size * found)


def inverse(matrix: Floats) -> Floats | None:
    """Return the inverse; None where the matrix is not positive definite."""
    factor, size = _scaled(matrix)
    if not factorise(factor):
        return None
    found = np.zeros_like(factor)
    _inverse(factor, np.zeros_like(factor), found)
    return np.asarray(found * np.outer(size, size))
