"""By how much cracks have opened and slid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import UNIT, XYZ, LengthUnit, array

_POINTS = ("point",)


@dataclass(frozen=True)
class CrackOpenings:
    """Points along the cracks of a tuple, crack by crack, in the order in which they follow each other.

    A crack has a right and a left side as seen on the way along its points. In the plane of an image nothing
    is known of what goes out of it.
    """

    view: str
    reference_state: str
    unit: LengthUnit
    crack: NDArray[np.int32] = array("1", "number of the crack, from 1", _POINTS)
    right: NDArray[np.int32] = array("1", "region on its right side", _POINTS)
    left: NDArray[np.int32] = array("1", "region on its left side", _POINTS)
    pixel: NDArray[np.float64] = array(
        "px", "place in the reference image", ("point", "component"), ("column", "row")
    )
    position: NDArray[np.float64] = array(
        UNIT, "position at the reference state", ("point", "component"), XYZ
    )
    along: NDArray[np.float64] = array(UNIT, "way along the crack from its first point", _POINTS)
    opening: NDArray[np.float64] = array(UNIT, "way of the left side from the right one, across", _POINTS)
    sigma_opening: NDArray[np.float32] = array(UNIT, "standard deviation of the opening", _POINTS)
    sliding: NDArray[np.float64] = array(UNIT, "way of the left side from the right one, along", _POINTS)
    sigma_sliding: NDArray[np.float32] = array(UNIT, "standard deviation of the sliding", _POINTS)
    tearing: NDArray[np.float64] | None = array(
        UNIT, "way of the left side from the right one, out of the surface", _POINTS, default=None
    )
    sigma_tearing: NDArray[np.float32] | None = array(
        UNIT, "standard deviation of the tearing", _POINTS, default=None
    )
