"""The normal matrix of a match, inverted."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, kernel


@inner
@kernel
def invert(matrix: Floats, inverse: Floats) -> bool:
    """Invert a small positive definite matrix by Cholesky's method; return False where it is not one.

    It is scaled to a unit diagonal first, so "not one" means singular to a part in 10^9 whatever the units.
    """
    n = matrix.shape[0]
    scale = np.empty(n)
    for i in range(n):
        if not matrix[i, i] > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    lower = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 1e-9:
                    return False
                lower[i, i] = np.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    half = np.zeros((n, n))  # the inverse of `lower`
    for i in range(n):
        half[i, i] = 1.0 / lower[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= lower[i, k] * half[k, j]
            half[i, j] = total / lower[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += half[k, i] * half[k, j]
            inverse[i, j] = total * (scale[i] * scale[j])
            inverse[j, i] = inverse[i, j]
    return True
