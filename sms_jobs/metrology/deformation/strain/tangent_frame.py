"""The frame of the tangent plane at a point of a surface, from the scatter of the points about it."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel


@inner
@uncounted_kernel
def _principal_axes(
    matrix: Floats,
    vectors: Floats,
) -> None:
    """Turn a symmetric 3 x 3 matrix to diagonal form by Jacobi's rotations; columns of `vectors` are axes."""
    for i in range(3):
        for j in range(3):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(12):
        off = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off <= 1e-16 * (matrix[0, 0] + matrix[1, 1] + matrix[2, 2]):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                theta = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    a = matrix[k, p]
                    b = matrix[k, q]
                    matrix[k, p] = c * a - s * b
                    matrix[k, q] = s * a + c * b
                for k in range(3):
                    a = matrix[p, k]
                    b = matrix[q, k]
                    matrix[p, k] = c * a - s * b
                    matrix[q, k] = s * a + c * b
                    a = vectors[k, p]
                    b = vectors[k, q]
                    vectors[k, p] = c * a - s * b
                    vectors[k, q] = s * a + c * b


@inner
@uncounted_kernel
def tangent_frame(
    scatter: Floats,
    towards: tuple[float, float, float],
    x_axis: Floats,
    vectors: Floats,
    frame: Floats,
) -> bool:
    """Fill the frame (rows x, y, z) at a point; return False where it has none.

    z is the direction in which the points scatter least, on the side of `towards`; x is `x_axis` projected
    onto the plane across it.
    """
    _principal_axes(scatter, vectors)
    least, middle, most = 0, 1, 2
    if scatter[middle, middle] < scatter[least, least]:
        least, middle = middle, least
    if scatter[most, most] < scatter[middle, middle]:
        middle, most = most, middle
    if scatter[middle, middle] < scatter[least, least]:
        least, middle = middle, least
    if not scatter[middle, middle] > 1e-2 * scatter[most, most]:
        return False
    z = vectors[:, least]
    sign = -1.0 if z[0] * towards[0] + z[1] * towards[1] + z[2] * towards[2] < 0.0 else 1.0
    height = x_axis[0] * z[0] + x_axis[1] * z[1] + x_axis[2] * z[2]
    length = 0.0
    for k in range(3):
        frame[2, k] = sign * z[k]
        frame[0, k] = x_axis[k] - height * z[k]
        length += frame[0, k] ** 2
    if not length > 1e-6:
        return False
    for k in range(3):
        frame[0, k] /= np.sqrt(length)
    for k in range(3):
        a = (k + 1) % 3
        b = (k + 2) % 3
        frame[1, k] = frame[2, a] * frame[0, b] - frame[2, b] * frame[0, a]
    return True
