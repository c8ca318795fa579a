"""What one sensor saw of a board in one pose, and why some of it is not used."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.wrapped_sheets import in_space


@dataclass(frozen=True)
class BoardView:
    """Points of a board in one pose, and their images in one sensor.

    Attributes
    ----------
    sensor, pose
        Names: C1, P1, ...; that of the pose is the same for all sensors that saw it.
    point
        (n, 3) in mm in the board's frame, z = 0; of a cylinder on its sheet.
    pixel
        (n, 2), their images.
    sigma_px
        (n,) standard deviations of the images in each direction.
    radius_mm
        About which the board's sheet is wrapped, see `wrapped_sheets`; infinite for a flat one.
    """

    sensor: str
    pose: str
    point: Floats
    pixel: Floats
    sigma_px: Floats
    radius_mm: float = inf

    def __post_init__(self) -> None:
        n = len(self.point)
        if self.point.shape != (n, 3) or self.pixel.shape != (n, 2) or self.sigma_px.shape != (n,):
            raise InvalidInput(
                f"{self.sensor} in pose {self.pose} has points {self.point.shape}, pixels {self.pixel.shape} "
                f"and standard deviations {self.sigma_px.shape}: give (n, 3), (n, 2) and (n,)"
            )
        if np.any(self.point[:, 2] != 0.0):
            raise InvalidInput(
                f"points of the board in pose {self.pose} have z up to "
                f"{np.abs(self.point[:, 2]).max():g} mm, but a board is flat: give z = 0 in its own frame"
            )
        if not (
            np.isfinite(self.point).all() and np.isfinite(self.pixel).all() and np.all(self.sigma_px > 0.0)
        ):
            raise InvalidInput(
                f"{self.sensor} in pose {self.pose} has points that are not finite or standard deviations "
                "that are not positive: leave such points out"
            )

    def part(self, kept: Mask) -> BoardView:
        """Return some of its points."""
        return replace(self, point=self.point[kept], pixel=self.pixel[kept], sigma_px=self.sigma_px[kept])

    @property
    def in_space(self) -> Floats:
        """The points (n, 3) in mm where they are in space, in the board's frame."""
        return in_space(self.point, self.radius_mm)


@dataclass(frozen=True)
class Refusal:
    """Points of a view that are not used: how many, and why.

    `wrong` says that the whole view is not what it is said to be, which a person has to look at.
    """

    sensor: str
    pose: str
    count: int
    reason: str
    wrong: bool = False
