"""Surfaces that measured ones are compared with, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.records.quantity import SYMMETRIC, XYZ, array


@dataclass(frozen=True)
class ReferenceSurface:
    """A surface as it should be, from a file of a CAD program; in a frame of its own.

    Attributes
    ----------
    filename, file_sha256
        Of the file that it was read from.
    file_unit
        In which that file counts; the vertices here are in mm.
    turned_over
        Whether the triangles of the file faced inwards, and were turned over.
    """

    filename: str
    file_sha256: str
    file_unit: str
    turned_over: bool
    vertices: Floats = array("mm", "position in the frame of the surface", ("vertex", "component"), XYZ)
    faces: NDArray[np.int32] = array(
        "1", "vertex indices, counter-clockwise seen from outside", ("face", "corner")
    )


@dataclass(frozen=True)
class SurfaceRegistration:
    """The rigid motion that lays what was measured on a reference surface: x_surface = R x_world + T.

    Attributes
    ----------
    filename, file_sha256
        Of the reference surface.
    rotation, translation_mm
        R, by rows, and T.
    scale
        Robust spread of the distances in units of their standard deviations, at least 1.
    rms_mm
        Of the distances, weighted.
    points, used_fraction
        How many points took part, and which part of them had weight.
    held
        Number of directions in which the surface does not tell where the points are.
    iterations, converged
        0 iterations for a motion that was given and kept.
    """

    filename: str
    file_sha256: str
    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    translation_mm: tuple[float, float, float]
    scale: float
    rms_mm: float
    points: int
    used_fraction: float
    held: int
    iterations: int
    converged: bool
    covariance: Floats = array(
        "mixed",
        "covariance of a small turn about the origin of the surface's frame (rad) and a shift (mm)",
        ("motion", "other motion"),
    )


@dataclass(frozen=True)
class DeviationField:
    """By how much the surface that a camera sees is off the reference surface.

    The verdict is 0 where nothing was compared, 1 within the tolerance with the whole interval of the
    uncertainty, 2 undecided, 3 outside with the whole interval.
    """

    camera: str
    views: tuple[str, ...]
    lower_mm: float
    upper_mm: float
    coverage_factor: float
    deviation: Floats = array("mm", "deviation from the reference surface, positive outside the material")
    sigma: Singles = array("mm", "standard deviation of the deviation")
    verdict: NDArray[np.uint8] = array("1", "verdict: 1 within tolerance, 2 undecided, 3 outside")
    position: Floats = array(
        "mm", "position in the frame of the reference surface", ("component", "row", "column"), XYZ
    )
    covariance: Singles = array(
        "mm^2",
        "covariance of the position in the frame of the reference surface, from phase noise",
        ("component", "row", "column"),
        SYMMETRIC,
    )
    reason: NDArray[np.uint32] = array("bit", "why a pixel has no value, 0 where it has one")
