"""Measured fields between pixels, by cubics that never mix two regions.

Measured fields end at the edges of their regions, so a cubic is used only where all its 4 x 4 pixels belong
to one region, and a plane fitted to the pixels of that region where they do not (thesis section 4.4.1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.compilation import in_row_blocks, inner, kernel, uncounted_kernel


@inner
@uncounted_kernel
def _cubic_weights(
    s: float,
    weights: Floats,
    slopes: Floats,
) -> None:
    """Fill the weights and slopes of Lagrange's cubic through -1, 0, 1, 2 at 0 <= s <= 1."""
    weights[0] = -s * (s - 1.0) * (s - 2.0) / 6.0
    weights[1] = (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0
    weights[2] = -(s + 1.0) * s * (s - 2.0) / 2.0
    weights[3] = (s + 1.0) * s * (s - 1.0) / 6.0
    slopes[0] = -(3.0 * s * s - 6.0 * s + 2.0) / 6.0
    slopes[1] = (3.0 * s * s - 4.0 * s - 1.0) / 2.0
    slopes[2] = -(3.0 * s * s - 2.0 * s - 2.0) / 2.0
    slopes[3] = (3.0 * s * s - 1.0) / 6.0


@inner
@kernel
def _plane_weights(
    labels: Labels,
    label: int,
    left: int,
    top: int,
    x: float,
    y: float,
    weights: Floats,
) -> bool:
    """Fill the weights (value, d/dx, d/dy) of a plane through the pixels of one region in a 4 x 4 block.

    Pixels count by 1 / (1/4 + squared distance). Returns False where they do not span a plane, or where
    the point lies more than a pixel outside them.
    """
    m = np.zeros(6)
    nearest = np.inf
    for j in range(4):
        for i in range(4):
            if labels[top + j, left + i] == label:
                dx = left + i - x
                dy = top + j - y
                d2 = dx * dx + dy * dy
                w = 1.0 / (0.25 + d2)
                nearest = min(nearest, d2)
                m[0] += w
                m[1] += w * dx
                m[2] += w * dy
                m[3] += w * dx * dx
                m[4] += w * dx * dy
                m[5] += w * dy * dy
    # The inverse of the normal matrix, by cofactors.
    c00 = m[3] * m[5] - m[4] * m[4]
    c01 = m[2] * m[4] - m[1] * m[5]
    c02 = m[1] * m[4] - m[2] * m[3]
    determinant = m[0] * c00 + m[1] * c01 + m[2] * c02
    if nearest > 1.0 or determinant < 1e-3 * m[0] * (m[3] + m[5]) ** 2:
        return False
    c11 = m[0] * m[5] - m[2] * m[2]
    c12 = m[1] * m[2] - m[0] * m[4]
    c22 = m[0] * m[3] - m[1] * m[1]
    for j in range(4):
        for i in range(4):
            w = 0.0
            dx = left + i - x
            dy = top + j - y
            if labels[top + j, left + i] == label:
                w = 1.0 / ((0.25 + dx * dx + dy * dy) * determinant)
            weights[0, j, i] = w * (c00 + c01 * dx + c02 * dy)
            weights[1, j, i] = w * (c01 + c11 * dx + c12 * dy)
            weights[2, j, i] = w * (c02 + c12 * dx + c22 * dy)
    return True


@inner
@uncounted_kernel
def _end_label(
    labels: Labels,
    x: float,
    y: float,
) -> int:
    """Return the label of the labelled pixel nearest to (x, y) among the four around it, 0 for none."""
    left = int(np.floor(x))
    top = int(np.floor(y))
    best = 2.0
    label = 0
    for j in range(max(top, 0), min(top + 2, labels.shape[0])):
        for i in range(max(left, 0), min(left + 2, labels.shape[1])):
            d2 = (i - x) ** 2 + (j - y) ** 2
            if labels[j, i] > 0 and d2 < best:
                best = d2
                label = labels[j, i]
    return label


@kernel
def _interpolate_rows(
    start: int,
    stop: int,
    field: Floats,
    covariance: Floats,
    labels: Labels,
    x: Floats,
    y: Floats,
    value: Floats,
    value_covariance: Floats,
    slope: Floats,
) -> None:
    """Do the work of `interpolate_in_region` for rows start .. stop of the points."""
    rows, columns = labels.shape
    across = np.empty((2, 4))
    down = np.empty((2, 4))
    weights = np.empty((3, 4, 4))
    for r in range(start, stop):
        for c in range(x.shape[1]):
            px = x[r, c]
            py = y[r, c]
            value[:, r, c] = np.nan
            value_covariance[:, r, c] = np.nan
            slope[:, :, r, c] = np.nan
            if not (px >= 0.0 and py >= 0.0 and px <= columns - 1.0 and py <= rows - 1.0):
                continue
            label = _end_label(labels, px, py)
            if label == 0:
                continue
            left = min(max(int(px) - 1, 0), columns - 4)
            top = min(max(int(py) - 1, 0), rows - 4)
            whole = left == int(px) - 1 and top == int(py) - 1
            for j in range(4):
                for i in range(4):
                    whole = whole and labels[top + j, left + i] == label
            if whole:
                _cubic_weights(px - int(px), across[0], across[1])
                _cubic_weights(py - int(py), down[0], down[1])
                for j in range(4):
                    for i in range(4):
                        weights[0, j, i] = down[0, j] * across[0, i]
                        weights[1, j, i] = down[0, j] * across[1, i]
                        weights[2, j, i] = down[1, j] * across[0, i]
            elif not _plane_weights(labels, label, left, top, px, py, weights):
                continue
            for k in range(value.shape[0]):
                total, along_x, along_y = 0.0, 0.0, 0.0
                for j in range(4):
                    for i in range(4):
                        if weights[0, j, i] != 0.0 or labels[top + j, left + i] == label:
                            own = field[k, top + j, left + i]
                            total += weights[0, j, i] * own
                            along_x += weights[1, j, i] * own
                            along_y += weights[2, j, i] * own
                value[k, r, c] = total
                slope[k, 0, r, c] = along_x
                slope[k, 1, r, c] = along_y
            for k in range(value_covariance.shape[0]):
                spread = 0.0
                for j in range(4):
                    for i in range(4):
                        if weights[0, j, i] != 0.0:
                            spread += weights[0, j, i] ** 2 * covariance[k, top + j, left + i]
                value_covariance[k, r, c] = spread


def interpolate_in_region(
    field: Floats,
    covariance: NDArray[np.floating],
    labels: NDArray[np.int32],
    x: Floats,
    y: Floats,
    threads: int = 1,
) -> tuple[Floats, Floats, Floats]:
    """Interpolate a measured field at sub-pixel places without ever mixing two regions.

    Parameters
    ----------
    field
        (k, rows, columns), in any unit; finite wherever `labels` is positive. At least 4 x 4 pixels.
    covariance
        (l, rows, columns), variances and covariances of the field, independent from pixel to pixel.
    labels
        (rows, columns), 0 where there is no region.
    x, y
        (m, n), px: where to interpolate; the region is that of the nearest labelled pixel around it.
    threads
        How many threads to use.

    Returns
    -------
    value
        (k, m, n); NaN where no region gives a value.
    covariance
        (l, m, n), carried through the weights of the interpolation.
    slope
        (k, 2, m, n), derivatives of the field by x and y, in the field's unit a pixel.

    Notes
    -----
    Lagrange's bicubic where its 4 x 4 pixels share a region, else a distance-weighted plane through those
    that do, reaching at most a pixel beyond them (thesis section 4.4.1 and Eq. (3.21)).
    """
    value = np.empty((field.shape[0], *x.shape))
    spread = np.empty((covariance.shape[0], *x.shape))
    slope = np.empty((field.shape[0], 2, *x.shape))
    noise = np.asarray(covariance, dtype=np.float64)

    def work(start: int, stop: int) -> None:
        _interpolate_rows(start, stop, field, noise, labels, x, y, value, spread, slope)

    in_row_blocks(work, x.shape[0], threads)
    return value, spread, slope
