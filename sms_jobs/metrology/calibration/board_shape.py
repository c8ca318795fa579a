"""The shape of a board that is not flat: bow along both sides, and twist.

What bends a plate as a whole is of low order: its own weight, screws, glue that shrinks, a print that was
stuck onto a curved sheet. With u and v from -1 to 1 across the board's points, a point stands out by

    z = bow_x (u^2 - 1/3) + bow_y (v^2 - 1/3) + twist u v.

A bow is how far the ends of a middle line lie above its middle: the sagitta. The thirds make the plane the
one that fits the board best, which keeps the frame of a board where it was when bow and twist are found.
The model is that of mrcal's calibration object, with a twist besides and with the stated flatness.
"""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats

Outline = tuple[tuple[float, float], tuple[float, float]]


def shape_terms(points: Floats, outline_mm: Outline) -> Floats:
    """Return by how much each term of `estimates.SHAPE`, at 1 mm, moves points out of the plane.

    Parameters
    ----------
    points
        (n, 2) or (n, 3) in mm, in the board's frame.
    outline_mm
        Lowest and highest x, then y, of the board's points.

    Returns
    -------
    (n, 3) in mm per mm.
    """
    low, high = np.asarray(outline_mm, dtype=np.float64).T
    u, v = ((2.0 * points[:, :2] - low - high) / (high - low)).T
    return np.stack([u * u - 1.0 / 3.0, v * v - 1.0 / 3.0, u * v], axis=-1)
