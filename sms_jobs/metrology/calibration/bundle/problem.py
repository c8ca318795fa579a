"""What a bundle adjustment is given: sensors, artefacts, their poses, and what was seen of them.

Sensors, artefacts and poses are named by their place in the tuples of the problem; a `BoardPose` and a
`BarPose` are numbered apart. All lengths in mm, angles in rad, images in px, standard deviations 1 sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import inf, isinf
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.estimates import SHAPE, Estimated
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS, Pose
from sms_jobs.metrology.geometry.lens import KEPT, Intrinsics


class ResidualType(StrEnum):
    """Of what a residual is the distance, as people call it; in the order of variance factors."""

    RAY_GAP = "ray gap"
    SPHERE_SURFACE = "sphere surface"
    BOARD_IN_CAMERA = "board in camera"
    BOARD_IN_PROJECTOR = "board in projector"

    @classmethod
    def of_board_in(cls, projector: bool) -> ResidualType:
        """Return the type of the points of a board in a projector, or in a camera."""
        return cls.BOARD_IN_PROJECTOR if projector else cls.BOARD_IN_CAMERA

    @property
    def of_board(self) -> bool:
        """Whether it is that of a point of a board, of which there are two coordinates."""
        return self in (ResidualType.BOARD_IN_CAMERA, ResidualType.BOARD_IN_PROJECTOR)

    @property
    def unit(self) -> Literal["mm", "px"]:
        """In which residuals of this type are given."""
        return "px" if self.of_board else "mm"


@dataclass(frozen=True)
class BundleSensor:
    """A camera or a projector, and where its parameters start from.

    Attributes
    ----------
    name
        C1, P1, ...
    intrinsics, pose
        The start; the pose maps the world into the sensor.
    size_px
        Columns and rows of its image.
    fixed
        Names of `SENSOR_PARAMETERS` that keep the values of the start.
    fixed_aspect
        Keep fy / fx at the ratio of the start.
    """

    name: str
    intrinsics: Intrinsics
    pose: Pose
    size_px: tuple[int, int]
    fixed: tuple[str, ...] = KEPT
    fixed_aspect: bool = False


@dataclass(frozen=True)
class BundleBoard:
    """A board: how well its pitch, the places of its points and its flatness are known (`records.artefacts`).

    Attributes
    ----------
    pitch_relative_sigma
        Of the scale; 0 where the pitch is held as it is given.
    point_sigma_mm
        Of one point's place, in each direction: the same in every pose, for a board is printed once.
    flatness_mm
        Standard deviation of bow and twist; 0 where the shape is held at `shape_mm`. 0 for a cylinder.
    outline_mm
        Lowest and highest x, then y, of the board's points.
    shape_mm
        Bow along x, bow along y and twist from which the adjustment starts, see `board_shape`; of a cylinder
        what its diameter is larger than told, 0 and 0.
    radius_mm
        About which the board's sheet is wrapped, as told, see `wrapped_sheets`; infinite for a flat one.
    diameter_sigma_mm
        Standard deviation of a cylinder's diameter; 0 where it is held.
    """

    name: str
    pitch_relative_sigma: float = 1e-3
    point_sigma_mm: float = 0.002
    flatness_mm: float = 0.0
    outline_mm: tuple[tuple[float, float], tuple[float, float]] = ((-1.0, 1.0), (-1.0, 1.0))
    shape_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius_mm: float = inf
    diameter_sigma_mm: float = 0.0

    @property
    def shape_sigma_mm(self) -> tuple[float, float, float]:
        """Standard deviations of `shape_mm`, 0 for what is held."""
        if isinf(self.radius_mm):
            return self.flatness_mm, self.flatness_mm, self.flatness_mm
        return self.diameter_sigma_mm, 0.0, 0.0

    @property
    def shape_terms(self) -> tuple[Estimated, ...]:
        """What `shape_mm` is made of, but for what a cylinder does not have."""
        return SHAPE if isinf(self.radius_mm) else (Estimated.DIAMETER,)


@dataclass(frozen=True)
class BundleBar:
    """A ball bar as certified, see `records.artefacts.BallBar`.

    Attributes
    ----------
    repeatability_mm
        How well its length stays the same from pose to pose.
    """

    name: str
    length_mm: float
    length_sigma_mm: float
    radius_mm: float
    radius_sigma_mm: float
    repeatability_mm: float = 0.0005


@dataclass(frozen=True)
class BoardPose:
    """A pose of a board: X_world = R X_board + T, from which the adjustment starts."""

    name: str
    board: int
    pose: Pose


@dataclass(frozen=True)
class BarPose:
    """A pose of a ball bar.

    Attributes
    ----------
    centres
        (2, 3) of spheres 1 and 2, from which the adjustment starts; NaN for one that nobody saw.
    """

    name: str
    bar: int
    centres: Floats


@dataclass(frozen=True)
class BoardPoints:
    """Points of a board that one sensor saw in one pose.

    Attributes
    ----------
    pose, sensor
        Places in the problem's tuples of board poses and sensors.
    projector
        Whether the sensor is a projector, which sees through the phase: a residual type of its own.
    point
        (n, 3), in the board's frame; of a cylinder on its sheet.
    pixel, sigma_px
        (n, 2) the points' images and (n,) their standard deviation in each direction.
    """

    pose: int
    sensor: int
    projector: bool
    point: Floats
    pixel: Floats
    sigma_px: Floats


@dataclass(frozen=True)
class BarPoints:
    """Points on the spheres of a bar that one pair saw in one pose.

    Attributes
    ----------
    pose, camera, projector
        Places in the problem's tuples of bar poses and sensors.
    sphere
        (n,) 1 or 2.
    camera_px
        (n, 2) centres of the camera's pixels, taken as exact.
    projector_px, sigma_px
        (n, 2) their images in the projector and the standard deviations of both coordinates, (n, 2), or (n,)
        where they are equal.
    """

    pose: int
    camera: int
    projector: int
    sphere: NDArray[np.int32]
    camera_px: Floats
    projector_px: Floats
    sigma_px: Floats


@dataclass(frozen=True)
class SensorPrior:
    """What is known of the sensors beforehand, for a recalibration on site.

    Attributes
    ----------
    information
        (p, p) inverse covariance of all parameters of all sensors, about the problem's start.
    """

    information: Floats


@dataclass(frozen=True)
class BundleProblem:
    """Everything one bundle adjustment is to fit.

    Attributes
    ----------
    sensors, boards, bars, board_poses, bar_poses
        What has parameters.
    board_points, bar_points
        What was seen.
    world_board
        The board pose that is kept as given and so fixes the world's frame. None: the frame is that of
        the prior where there is one, else that of the first sensor, whose pose is kept as given.
    prior
        Of the sensors.
    volume
        Low and high corner of the box in which the calibration is to hold, (3,) each; None for the box
        around everything that was observed.
    """

    sensors: tuple[BundleSensor, ...]
    boards: tuple[BundleBoard, ...] = ()
    bars: tuple[BundleBar, ...] = ()
    board_poses: tuple[BoardPose, ...] = ()
    bar_poses: tuple[BarPose, ...] = ()
    board_points: tuple[BoardPoints, ...] = ()
    bar_points: tuple[BarPoints, ...] = ()
    world_board: int | None = None
    prior: SensorPrior | None = None
    volume: tuple[Floats, Floats] | None = None

    def __post_init__(self) -> None:
        _within("board", [p.board for p in self.board_poses], len(self.boards))
        _within("bar", [p.bar for p in self.bar_poses], len(self.bars))
        _within("board pose", [p.pose for p in self.board_points], len(self.board_poses))
        _within("bar pose", [p.pose for p in self.bar_points], len(self.bar_poses))
        named = [p.sensor for p in self.board_points]
        named += [i for p in self.bar_points for i in (p.camera, p.projector)]
        _within("sensor", named, len(self.sensors))
        if self.world_board is not None:
            _within("board pose", [self.world_board], len(self.board_poses))
        for sensor in self.sensors:
            unknown = set(sensor.fixed) - set(SENSOR_PARAMETERS)
            if unknown:
                raise InvalidInput(
                    f"sensor {sensor.name} has no parameter {', '.join(sorted(unknown))}; its parameters are "
                    + ", ".join(SENSOR_PARAMETERS)
                )
        size = PER_SENSOR * len(self.sensors)
        if self.prior is not None and self.prior.information.shape != (size, size):
            raise InvalidInput(
                f"the prior's information is {self.prior.information.shape}, but {len(self.sensors)} sensors "
                f"have {size} parameters: give {size} x {size}"
            )

    @property
    def gauge(self) -> str:
        """Say what fixes the world's frame."""
        if self.world_board is not None:
            return f"board frame of pose {self.board_poses[self.world_board].name}"
        if self.prior is not None:
            return "frame of the prior calibration"
        return f"pin-hole frame of {self.sensors[0].name}"


def _within(what: str, numbers: list[int], count: int) -> None:
    for number in numbers:
        if not 0 <= number < count:
            raise InvalidInput(f"{what} {number} is named, but the problem has {count}, counted from 0")


@dataclass(frozen=True)
class BundleOptions:
    """How a bundle adjustment is done.

    Attributes
    ----------
    huber
        From which distance on, in standard deviations of its own type, an observation (always a pair of
        residuals) pulls no harder; infinite for plain least squares.
    reject
        Beyond which distance, in the same unit, an observation is left out once the fit stands.
    least_incidence
        Points whose camera ray meets the sphere with a smaller cosine are left out: a grazing ray tells
        nothing of the surface.
    estimate_variances
        Estimate the variance of each residual type from its residuals; otherwise trust what is stated.
    most_iterations
        Before the adjustment is given up.
    cost_tolerance
        Relative change of the cost at which it has converged.
    judge_points
        Ask whether the points of boards are where they are told to be.
    threads
        Number of threads; the result does not depend on it.
    """

    huber: float = 3.0
    reject: float = 6.0
    least_incidence: float = 0.2
    estimate_variances: bool = True
    most_iterations: int = 60
    cost_tolerance: float = 1e-10
    judge_points: bool = True
    threads: int = 1
