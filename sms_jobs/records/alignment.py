"""How the views of a rig from several positions lie to each other."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.quantity import XYZ, array

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class ViewAlignment:
    """The motion that brings another campaign's frame into this one's: x_here = R x_there + T.

    Attributes
    ----------
    campaign
        The other one.
    rotation, translation_mm
        R and T.
    scale
        Robust scatter of the residuals in units of what is stated of the points, at least 1.
    rms_mm
        Rms length of the residuals of the points that took part.
    points, used_fraction
        Points that both views see, and which part of them took part.
    """

    campaign: str
    rotation: tuple[Vector, Vector, Vector]
    translation_mm: Vector
    scale: float
    rms_mm: float
    points: int
    used_fraction: float
    covariance: Floats = array(
        "mixed",
        "covariance of a small turn about the origin of the frame here (rad) and a shift (mm)",
        ("motion", "other motion"),
    )
    place: Floats = array("mm", "position of the common points, here", ("point", "component"), XYZ)
    residual: Floats = array(
        "mm", "position there, brought here, minus position here", ("point", "component"), XYZ
    )
