"""Where a specimen's own frame lies in the world of its rig, and from what that was found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose

Vector: TypeAlias = tuple[float, float, float]

_ROUNDING = 1e-9


@dataclass(frozen=True)
class FramePoint:
    """A point that a frame was found by: where it lies in the world, and the pixel (column, row) it has."""

    position_mm: Vector
    pixel: tuple[float, float] | None = None


@dataclass(frozen=True)
class FrameDeviation:
    """Standard deviations of a frame: of small turns about its own x, y, z, and of its origin along them."""

    turn_rad: Vector
    origin_mm: Vector


@dataclass(frozen=True)
class SpecimenFrame:
    """The specimen's own frame: right-handed, x along the specimen, z outwards.

    Attributes
    ----------
    method
        Three points, or two and a plane that was fitted to a region.
    placement
        Brings it into the world: x_world = R x_specimen + T.
    points
        The origin, a point of the x axis and, of three, one of the xy plane.
    view
        Whose reference surface the pixels and the region are of; None for points of the world.
    surface
        Content hash of the file of that surface.
    region
        Outlines of the region in the image, as correlate takes them; of a fitted plane.
    markers
        Whether the points are the middles of round marks that were found beside what was pointed at.
    rms_mm
        Of the distances of the region's points from their plane.
    deviation
        From noise, from how well a person points, and of a plane from its flatness; None where it is not
        known, as of points of the world.
    calibration
        What the calibration adds to it; None where that is not known.
    version
        Of this description of a frame.
    """

    method: Literal["points", "plane"]
    placement: Pose
    points: tuple[FramePoint, ...]
    view: str | None = None
    surface: str | None = None
    region: str = ""
    markers: bool = False
    rms_mm: float | None = None
    deviation: FrameDeviation | None = None
    calibration: FrameDeviation | None = None
    version: Literal[1] = 1

    def __post_init__(self) -> None:
        turn = self.placement.matrix()
        off = float(np.abs(turn @ turn.T - np.eye(3)).max())
        if not (off < _ROUNDING and np.linalg.det(turn) > 0.0):
            raise InvalidInput(
                f"the axes of a specimen's frame are {off:.2g} off being square and of length 1, and may be "
                f"{_ROUNDING:g}; find the frame again"
            )

    @property
    def x_axis(self) -> Vector:
        """The specimen's x axis in the world, of length 1."""
        x, y, z = self.placement.matrix()[:, 0]
        return (float(x), float(y), float(z))
