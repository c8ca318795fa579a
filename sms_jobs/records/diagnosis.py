"""What a measurement says about the instruments that made it."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.quantity import XYZ, array

POINTS = ("point",)
ORIENTED = ("orientation",)
HARMONICS = ("orientation", "harmonic")


@dataclass(frozen=True)
class ResponseDiagnosis:
    """What a projector makes of the fringes it is sent, and what that does to shape, at sampled pixels.

    `ripple` is by how much temporal unwrapping moves a point because the projector is not linear. The
    harmonics begin with the fringe itself, which is 1.
    """

    camera: str
    projector: str
    orientations_rad: tuple[float, ...]
    densities: tuple[int | float, ...]
    steps: int
    visibility: float
    x: Floats = array("px", "column", POINTS)
    y: Floats = array("px", "row", POINTS)
    ripple: Floats = array(
        "mm", "predicted displacement of a point by the projector's response", ("component", "point"), XYZ
    )
    ripple_omega: Floats = array("rad", "predicted error of the phase gradient", ("orientation", "point"))
    gamma: Floats = array("1", "exponent of the projector's response", ORIENTED)
    gamma_sigma: Floats = array("1", "standard deviation of the exponent", ORIENTED)
    harmonics: Floats = array("1", "harmonics of the fringes, in units of the first", HARMONICS)
    harmonics_sigma: Floats = array("1", "standard deviation of the harmonics", HARMONICS)
    damping: Floats = array(
        "1", "d by which blur lowers harmonic n of density t as exp(-d n^2 t^2)", ORIENTED
    )
