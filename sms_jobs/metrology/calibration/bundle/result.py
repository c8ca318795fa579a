"""What a bundle adjustment finds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.calibration.bundle.problem import ResidualType
from sms_jobs.metrology.calibration.estimates import Estimated, name_of
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics


@dataclass(frozen=True)
class Rms:
    """How large the residuals of some observations are.

    Attributes
    ----------
    of
        What they have in common: a sensor, a pair, a pose, or everything.
    name
        Its name: "C1", "C1P2", "B03", "all".
    type
        Of the residuals.
    count
        Number of observations that were used; each has both coordinates, or one gap, or one surface
        residual.
    rejected
        Number that were left out.
    rms
        In `unit`, of the observations that were used; of points of a board, of each coordinate.
    whitened
        Rms over the standard deviation stated with the observations: 1 when that is right.
    """

    of: Literal["all", "sensor", "pair", "pose"]
    name: str
    type: ResidualType
    count: int
    rejected: int
    rms: float
    whitened: float

    @property
    def unit(self) -> Literal["mm", "px"]:
        """Of `rms`."""
        return self.type.unit


@dataclass(frozen=True)
class AdjustedSensor:
    """A sensor as it was found to be."""

    name: str
    intrinsics: Intrinsics
    pose: Pose


@dataclass(frozen=True)
class Nuisance:
    """A length that is known beforehand and estimated along: of a bar, a radius, a board's pitch or its bow.

    Attributes
    ----------
    what, artefact
        What it is of which bar or board.
    prior, prior_sigma, value, sigma
        Beforehand and afterwards.
    z
        (value - prior) over its standard deviation under the prior, sqrt(prior_sigma^2 - sigma^2).
    sphere
        Of which sphere of a bar, 1 or 2; None of what is of the whole artefact.
    """

    what: Estimated
    artefact: str
    prior: float
    prior_sigma: float
    value: float
    sigma: float
    z: float
    sphere: int | None = None

    @property
    def name(self) -> str:
        """How people call it."""
        return name_of(self.what, self.artefact, self.sphere)

    @property
    def unit(self) -> str:
        """Of its values."""
        return self.what.unit


@dataclass(frozen=True)
class Adjustment:
    """The result of a bundle adjustment.

    Attributes
    ----------
    sensors
        As in the problem.
    board_poses
        X_world = R X_board + T, as in the problem.
    centres
        (bar poses, 2, 3) in mm; NaN for spheres with too few points.
    nuisance
        Lengths and radii of each bar, then the pitch scale and the shape of each board.
    names
        Of all parameters, fixed ones too: "C1.fx", "board B02.tx", "bar A07.sphere1.x", ...; those
        of the sensors first.
    covariance
        (parameters, parameters); rows and columns of what was kept fixed are 0.
    free
        (parameters,) whether each was estimated.
    gauge
        What fixes the world's frame.
    iterations
        Normal equations that were solved.
    cost
        Half the sum of squares (or its robust counterpart) at the end, in units of the estimated variances.
    redundancy
        Residuals less estimated parameters.
    variance_factors
        Estimated over stated standard deviation of each type that occurs.
    rms
        By type for everything, and by sensor, pair and pose.
    refused
        Why observations were left out, and how many.
    used_board, used_bar
        Which points were used, for each item of the problem's `board_points` and `bar_points`.
    residual_board, residual_bar
        Residuals of all these points, NaN where there is none: (n, 2) in px, observed less predicted, and
        (n, 2) in mm, (ray gap, sphere surface).
    warnings
        What a person should look at before trusting the result.
    point_rms_mm
        See `PointsFound`.
    shape_sigma_mm, scale_sigma
        See `Determined`.
    missing_radial
        See `bundle_lens_signature.missing_radial`.
    """

    sensors: tuple[AdjustedSensor, ...]
    board_poses: tuple[Pose, ...]
    centres: Floats
    nuisance: tuple[Nuisance, ...]
    names: tuple[str, ...]
    covariance: Floats
    free: Mask
    gauge: str
    iterations: int
    cost: float
    redundancy: float
    variance_factors: dict[ResidualType, float]
    rms: tuple[Rms, ...]
    refused: dict[str, int]
    used_board: tuple[Mask, ...]
    used_bar: tuple[Mask, ...]
    residual_board: tuple[Floats, ...]
    residual_bar: tuple[Floats, ...]
    warnings: tuple[str, ...]
    point_rms_mm: float
    shape_sigma_mm: float
    scale_sigma: float
    missing_radial: dict[str, float]

    def sensor(self, name: str) -> int:
        """Return the place of the sensor of that name; raise `ValueError` where there is none."""
        return [s.name for s in self.sensors].index(name)
