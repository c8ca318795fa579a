"""By how much measured points are off a reference surface, with the uncertainty of that and a verdict."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.rigid_alignment import rigid_modes
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import transform
from sms_jobs.metrology.surfaces.registration import MeasuredPoints, distances_to
from sms_jobs.metrology.surfaces.triangle_surface import TriangleSurface

PERCENTILES = (2.5, 25.0, 50.0, 75.0, 97.5)


class Verdict(IntEnum):
    """Whether a point conforms to the tolerance, given its uncertainty (ISO 14253-1)."""

    NOT_MEASURED = 0
    WITHIN = 1
    """The whole interval of the uncertainty is within the tolerance."""
    UNDECIDED = 2
    """A limit of the tolerance is within the interval of the uncertainty."""
    OUTSIDE = 3
    """The whole interval is outside."""


@dataclass(frozen=True)
class Deviations:
    """Signed distances of points to a reference surface.

    Attributes
    ----------
    xyz
        (points, 3) in mm, in the frame of the reference surface.
    deviation
        (points,) in mm, positive outside the material; NaN where the point has no counterpart.
    sigma
        (points,) in mm: noise of the point along the distance, and what is not known of the registration.
    """

    xyz: Floats
    deviation: Floats
    sigma: Floats


@dataclass(frozen=True)
class DeviationStatistics:
    """Deviations of one surface in numbers, in mm; NaN where nothing was compared.

    Attributes
    ----------
    points
        That have a counterpart.
    mean, rms, standard_deviation, minimum, maximum
        Of the deviations.
    percentiles
        At `PERCENTILES`.
    sigma_median
        Of the standard deviations.
    within, undecided, outside
        Fractions of the points by `Verdict`.
    """

    points: int
    mean: float
    rms: float
    standard_deviation: float
    minimum: float
    maximum: float
    percentiles: tuple[float, ...]
    sigma_median: float
    within: float
    undecided: float
    outside: float


def deviations(
    surface: TriangleSurface,
    points: MeasuredPoints,
    pose: Pose,
    covariance: Floats,
    *,
    within_mm: float = np.inf,
    threads: int = 1,
) -> Deviations:
    """Return the signed distances of points to a surface.

    Parameters
    ----------
    surface
        The reference.
    points
        What was measured.
    pose
        x_surface = R x + T of the points.
    covariance
        (6, 6) of the pose, a small turn about the surface's origin (rad) and a shift (mm).
    within_mm
        Points farther away than this have no counterpart, like those beside the rim of the surface and those
        that face away from it.
    threads
        Number of threads; the result does not depend on it.

    Notes
    -----
    sigma^2 = n^T C n + J P J^T with the direction n of the distance, the covariance C of the point,
    J = n^T [-[x]x I], and the covariance P of the pose.
    """
    closest, sigma, trusted = distances_to(surface, points, pose, within_mm, threads)
    xyz = transform(pose, points.xyz)
    gradient = np.einsum("ni,nij->nj", closest.direction, rigid_modes(xyz))
    moved = np.einsum("ni,ij,nj->n", gradient, covariance, gradient)
    return Deviations(
        xyz,
        np.where(trusted, closest.distance, np.nan),
        np.where(trusted, np.sqrt(sigma**2 + moved), np.nan),
    )


def verdicts(
    deviation: NDArray[np.floating],
    sigma: NDArray[np.floating],
    lower_mm: float,
    upper_mm: float,
    coverage_factor: float = 2.0,
) -> NDArray[np.uint8]:
    """Say of each deviation whether it conforms to a tolerance, as `Verdict`.

    Parameters
    ----------
    deviation, sigma
        In mm, of one shape.
    lower_mm, upper_mm
        Limits of the tolerance.
    coverage_factor
        Standard deviations on each side that make the interval of the uncertainty; 0 leaves it out.

    Raises
    ------
    InvalidInput
        The lower limit is not below the upper one, or the factor is negative.
    """
    if not lower_mm < upper_mm:
        raise InvalidInput(
            f"the lower limit of a tolerance, {lower_mm:g} mm, must be below the upper, {upper_mm:g} mm"
        )
    if coverage_factor < 0.0:
        raise InvalidInput(f"a coverage factor is 0 or more, not {coverage_factor:g}")
    half = coverage_factor * sigma
    with np.errstate(invalid="ignore"):
        within = (deviation - half >= lower_mm) & (deviation + half <= upper_mm)
        outside = (deviation + half < lower_mm) | (deviation - half > upper_mm)
    found = np.full(np.shape(deviation), Verdict.UNDECIDED, np.uint8)
    found[within] = Verdict.WITHIN
    found[outside] = Verdict.OUTSIDE
    found[~np.isfinite(deviation)] = Verdict.NOT_MEASURED
    return found


def statistics_of(
    deviation: NDArray[np.floating], sigma: NDArray[np.floating], verdict: NDArray[np.uint8]
) -> DeviationStatistics:
    """Return deviations in numbers; arrays of one shape, the deviations and sigmas in mm."""
    finite = np.isfinite(deviation)
    count = int(np.count_nonzero(finite))
    if count == 0:
        nan = float("nan")
        return DeviationStatistics(0, nan, nan, nan, nan, nan, (nan,) * len(PERCENTILES), nan, nan, nan, nan)
    values = np.asarray(deviation[finite], np.float64)
    shares = [float(np.count_nonzero(verdict == v)) / count for v in (1, 2, 3)]
    return DeviationStatistics(
        count,
        float(values.mean()),
        float(np.sqrt(np.mean(values**2))),
        float(values.std()),
        float(values.min()),
        float(values.max()),
        tuple(float(p) for p in np.percentile(values, PERCENTILES)),
        float(np.median(sigma[finite])),
        *shares,
    )
