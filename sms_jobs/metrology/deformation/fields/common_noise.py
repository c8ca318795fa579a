"""What the match in time and the shapes that cameras measure have in common: the noise of one image.

The reference camera's image of a state goes into both: it is matched with the partners' for the shape of that
state, and with its own of the other state for where the point has moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Labels
from sms_jobs.metrology.compilation import in_row_blocks, inlined, kernel


@dataclass(frozen=True)
class CommonNoise:
    """The noise of the reference camera's images, as the match in time sees it.

    Attributes
    ----------
    match
        (2, rows, columns) in px^2: the variances of u and v by the noise of both images, half of each.
    correlation
        (rows, columns), of what an image's noise does to this match and to that between cameras.
    pin_hole
        (3,) in mm: the reference camera's, from which its points move away along their rays.
    """

    match: Floats
    correlation: Floats
    pin_hole: Floats

    def part(self, box: tuple[slice, slice]) -> CommonNoise:
        """Return it for rows and columns."""
        return CommonNoise(
            np.ascontiguousarray(self.match[:, *box]),
            np.ascontiguousarray(self.correlation[box]),
            self.pin_hole,
        )


@inlined
def _gradient(end_x: Floats, end_y: Floats, labels: Labels, r: int, c: int, out: Floats) -> None:
    """Fill in how the end pixel changes with the reference pixel, (2, 2): dx'/dx, dx'/dy; dy'/dx, dy'/dy.

    Between the neighbours of its region; as the reference where it has none.
    """
    rows, columns = labels.shape
    for axis in range(2):
        r1, c1 = min(r + axis, rows - 1), min(c + 1 - axis, columns - 1)
        r0, c0 = max(r - axis, 0), max(c - 1 + axis, 0)
        if labels[r1, c1] != labels[r, c] or np.isnan(end_x[r1, c1]):
            r1, c1 = r, c
        if labels[r0, c0] != labels[r, c] or np.isnan(end_x[r0, c0]):
            r0, c0 = r, c
        steps = r1 - r0 + c1 - c0
        out[0, axis], out[1, axis] = 1.0 - axis, 1.0 * axis
        if steps > 0:
            out[0, axis] = (end_x[r1, c1] - end_x[r0, c0]) / steps
            out[1, axis] = (end_y[r1, c1] - end_y[r0, c0]) / steps


@kernel
def _take_rows(
    start: int, stop: int, first: Floats, end: Floats, labels: Labels, slope: Floats, at_rest: Floats,
    deformed: Floats, end_x: Floats, end_y: Floats, match: Floats, correlation: Floats, pin_hole: Floats,
    spread: Floats,
) -> None:  # fmt: skip
    """Do the work of `take_common_noise` for rows start .. stop."""
    gradient, moved, ray = np.empty((2, 2)), np.empty((2, 3)), np.empty((2, 3))
    by_start = np.empty((2, 3))
    for r in range(start, stop):
        for c in range(labels.shape[1]):
            if labels[r, c] == 0 or np.isnan(end[0, r, c]) or np.isnan(match[0, r, c]):
                continue
            y, x = np.int64(np.rint(end_y[r, c])), np.int64(np.rint(end_x[r, c]))
            if not (0 <= y < deformed.shape[1] and 0 <= x < deformed.shape[2]):
                continue
            if np.isnan(at_rest[0, r, c]) or np.isnan(deformed[0, y, x]):
                continue
            _gradient(end_x, end_y, labels, r, c, gradient)
            for i in range(3):
                for a in range(2):
                    by_start[a, i] = slope[i, 0, r, c] * gradient[0, a] + slope[i, 1, r, c] * gradient[1, a]
                ray[0, i], ray[1, i] = first[i, r, c] - pin_hole[i], end[i, r, c] - pin_hole[i]
            alike = correlation[r, c]
            for state in range(2):
                away = alike / np.sqrt(ray[state, 0] ** 2 + ray[state, 1] ** 2 + ray[state, 2] ** 2)
                for i in range(3):
                    moved[state, i] = 0.0
                for a in range(2):
                    if state == 0:
                        own = away * np.sqrt(0.5 * match[a, r, c]) * at_rest[a, r, c]
                    else:
                        own = gradient[a, 0] ** 2 * match[0, r, c] + gradient[a, 1] ** 2 * match[1, r, c]
                        own = away * np.sqrt(0.5 * own) * deformed[a, y, x]
                    for i in range(3):
                        moved[state, i] += own * (slope[i, a, r, c] if state else by_start[a, i])
            at = 0
            for i in range(3):
                for j in range(i, 3):
                    change = 0.0
                    for a in range(2):
                        change += match[a, r, c] * by_start[a, i] * by_start[a, j]
                        change -= match[a, r, c] * slope[i, a, r, c] * slope[j, a, r, c]
                        change -= moved[a, i] * ray[a, j] + moved[a, j] * ray[a, i]
                    spread[at, r, c] += change
                    at += 1


def take_common_noise(
    spread: Floats,
    points: tuple[Floats, Floats],
    labels: Labels,
    slope: Floats,
    own_noise: tuple[NDArray[np.floating], NDArray[np.floating]],
    end_pixel: tuple[Floats, Floats],
    common: CommonNoise,
    threads: int = 1,
) -> None:
    """Take from a displacement's covariance what match and shapes have in common, which cancels in part.

    Parameters
    ----------
    spread
        (6, rows, columns) in mm^2, packed, as if match and shapes were independent; changed in place.
    points
        Where points are at the reference state and where at the other, (3, rows, columns) in mm.
    labels
        (rows, columns), regions of the reference; 0 for none.
    slope
        (3, 2, rows, columns) in mm / px: how the deformed surface changes along its own image.
    own_noise
        (2, rows, columns) in mm of each state, the second for all of its image: how far one standard
        deviation of the noise of the camera's own image moves a point away from the camera, where it moves
        what is matched along columns and along rows; NaN where nothing is known.
    end_pixel
        Where points are seen at the other state, x and y (rows, columns) in px.
    common
        What the noise does to the match.
    threads
        How many threads to use; the result does not depend on it.

    Notes
    -----
    To first order a subset in a noisy image looks like that of the exact texture e px further on, with
    e = (sum J J^T)^-1 sum J n. Of state 0 the noise lets the point end F e0 px further on in the image, F
    being the gradient of the end pixel, and moves the point by t0 . e0' / s' along its ray d0. Of state 1 it
    lets the match end e1 px earlier, and moves the point there by t1 . e1' / s' along d1. With S the
    slope of the deformed surface along its image, the displacement is off by

        S F e0 - d0 (t0 . e0') / s' - S e1 + d1 (t1 . e1') / s'

    besides the partners' noise. Subsets in time and between cameras are of different sizes, but see the
    same noise: cov(e, e') = k diag(s s'). So the covariance is that of independent parts, less
    k sym(S F diag(s) t0 d0^T) and less k sym(S diag(s1) t1 d1^T), where sym A = A + A^T. The match's own
    part is carried by S F, since its deviations s are those in the reference image; s1 are those of F e.
    With k = 1 the point moves along the ray of a partner instead of that of the camera.
    """
    first, end = points
    at_rest, deformed = (np.ascontiguousarray(one, dtype=np.float64) for one in own_noise)

    def work(start: int, stop: int) -> None:
        _take_rows(
            start, stop, first, end, labels, slope, at_rest, deformed, *end_pixel, common.match,
            common.correlation, common.pin_hole, spread,
        )  # fmt: skip

    in_row_blocks(work, len(labels), threads)
