"""Sheets about cylinders: where a place on the sheet is in space.

A sheet touches its cylinder at the origin, with x around and y along the axis. The radius has the sign of the
axis's z: positive where the cylinder lies at positive z. A flat sheet is one of infinite radius.
"""

from __future__ import annotations

from math import isinf

import numpy as np

from sms_jobs.metrology.arrays import Floats


def in_space(points: Floats, radius_mm: float) -> Floats:
    """Return places of a sheet (n, 3) with z = 0, in mm, where they are in space, (n, 3).

    x becomes R sin(x / R), z becomes R (1 - cos(x / R)): lengths along the outside are kept.
    """
    if isinf(radius_mm):
        return points
    turn = points[:, 0] / radius_mm
    return np.stack([radius_mm * np.sin(turn), points[:, 1], radius_mm * (1.0 - np.cos(turn))], axis=-1)


def around_in_space(x: Floats, radius_mm: float) -> Floats:
    """Return the derivatives of places in space by their x on the sheet, (n, 3); those by y are (0, 1, 0)."""
    turn = x / radius_mm
    return np.stack([np.cos(turn), np.zeros_like(x), np.sin(turn)], axis=-1)
