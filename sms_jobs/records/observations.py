"""What was seen of a calibration artefact in one measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.records.quantity import array

_PIXEL = ("x", "y")
_POINTS = ("point", "component")


@dataclass(frozen=True)
class BoardObservation:
    """The points of a board that a view found, in both of its images, or a camera alone in its own.

    Attributes
    ----------
    artefact
        Name of the board in its session.
    place
        Column and row of each point on the board.
    point
        Where it is on the board, in the board's frame; z = 0. Of a cylinder on its sheet, as if it were flat.
    camera_px, projector_px
        Its image in the camera and, through the phase, in the projector; for a dot the image of its
        centre, not the centre of its image. NaN for the projector of a camera alone.
    camera_sigma_px, projector_sigma_px
        Standard deviations, in each direction.
    blur_px
        Standard deviation of the spot that a pixel of the camera sees; NaN where the board does not tell it.
    camera, projector
        Names of the sensors; that of the projector is empty for a camera alone.
    refused
        Why points that were found are not among them, and how many.
    reason
        Why the board was not found, and what to do; empty where it was.
    """

    camera: str
    projector: str
    artefact: str
    blur_px: float
    refused: dict[str, int]
    place: NDArray[np.int32] = array("1", "column and row on the board", _POINTS, ("column", "row"))
    point: NDArray[np.float64] = array("mm", "place on the board", _POINTS, ("x", "y", "z"))
    camera_px: NDArray[np.float64] = array("px", "image in the camera", _POINTS, _PIXEL)
    camera_sigma_px: NDArray[np.float64] = array("px", "standard deviation in the camera", ("point",))
    projector_px: NDArray[np.float64] = array("px", "image in the projector", _POINTS, _PIXEL)
    projector_sigma_px: NDArray[np.float64] = array("px", "standard deviation in the projector", ("point",))
    reason: str = ""


@dataclass(frozen=True)
class BarObservation:
    """Points on the spheres of a ball bar that a view found.

    Attributes
    ----------
    artefact
        Name of the bar in its session.
    sphere
        1 or 2, for each point.
    camera_px
        Centre of the camera's pixel.
    projector_px, projector_sigma_px
        Its image in the projector, through the phase, and the standard deviations of both coordinates.
    centre, centre_sigma
        Of each sphere, with the calibration that the search started from; NaN where it was not seen.
    camera, projector
        Names of the sensors.
    refused
        Why points were left out, and how many.
    searched_fraction
        Part of the image's pixels that was searched for the spheres.
    """

    camera: str
    projector: str
    artefact: str
    refused: dict[str, int]
    searched_fraction: float
    sphere: NDArray[np.int32] = array("1", "number of the sphere", ("point",))
    camera_px: NDArray[np.float64] = array("px", "pixel of the camera", _POINTS, _PIXEL)
    projector_px: NDArray[np.float64] = array("px", "image in the projector", _POINTS, _PIXEL)
    projector_sigma_px: NDArray[np.float64] = array(
        "px", "standard deviation in the projector", _POINTS, _PIXEL
    )
    centre: NDArray[np.float64] = array("mm", "centre", ("sphere", "component"), ("X", "Y", "Z"))
    centre_sigma: NDArray[np.float64] = array(
        "mm", "standard deviation of the centre", ("sphere", "component"), ("X", "Y", "Z")
    )
