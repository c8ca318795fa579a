"""What was taken out of a displacement: the motion that a region made as a rigid body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import LengthUnit, array

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class RegionMotion:
    """The rigid motion of a region from the reference state to another, x -> R (x - c) + c + t.

    In the frame of the surface. In the plane of an image it is a turn about Z, and a shift in X and Y.

    Attributes
    ----------
    region
        Outlines in the reference image, as correlate takes them.
    unit
        Of c and t.
    middle, translation
        c and t.
    rotation_rad
        Axis of R times its angle.
    sigma_translation, sigma_rotation_rad
        Standard deviations along and about X, Y, Z, from how much parts of the region differ.
    sigma_calibration_translation, sigma_calibration_rotation_rad
        What the calibration adds to them; None where that is not known.
    rms
        Of the displacements that are left of the region, in `unit`.
    pixels, used_fraction
        Of the region with a displacement, and which part of them took part.
    """

    view: str
    reference_state: str
    region: str
    unit: LengthUnit
    middle: Vector
    translation: Vector
    rotation_rad: Vector
    sigma_translation: Vector
    sigma_rotation_rad: Vector
    sigma_calibration_translation: Vector | None
    sigma_calibration_rotation_rad: Vector | None
    rms: float
    pixels: int
    used_fraction: float
    covariance: NDArray[np.float64] = array(
        "mixed",
        "covariance of a small turn about X, Y, Z at the middle (rad) and of the translation",
        ("motion", "other motion"),
    )
