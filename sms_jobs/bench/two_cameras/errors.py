"""Errors of points that two cameras measure, against exact truth: in mm, in units of sigma and in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.metrology.geometry.planes import covariance_in_space, trace
from sms_jobs.records.fields import DisplacementField, Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Sensor
from sms_jobs.virtual_rig.truth import Shape, Truth

OUTLIER_SIGMAS = 6.0
OUTLIER_PX = 0.05
"""A point is an outlier whose error is larger than both, the latter as the partner sees it."""


@dataclass(frozen=True)
class PointErrors:
    """Errors of n points that are reported valid.

    Attributes
    ----------
    length_mm
        (n,), length of the error; infinite where there is nothing that could have been measured.
    sigma_mm
        (n,), what the covariance says of that length: the root of its trace.
    seen_px
        (n,), by how much the partner sees the point beside where it is.
    visible
        How many points both cameras see.
    """

    length_mm: Floats
    sigma_mm: Floats
    seen_px: Floats
    visible: int

    @property
    def outliers(self) -> int:
        """How many errors are larger than `OUTLIER_SIGMAS` and than `OUTLIER_PX`."""
        wrong = (self.length_mm > OUTLIER_SIGMAS * self.sigma_mm) & ~(self.seen_px <= OUTLIER_PX)
        return int(np.count_nonzero(wrong))

    @property
    def valid_part(self) -> float:
        """Part of the points seen by both cameras that is reported valid."""
        return len(self.length_mm) / max(self.visible, 1)

    @property
    def normalised(self) -> Floats:
        """(n,), errors in units of what is said of them, of the points that there are."""
        return (self.length_mm / self.sigma_mm)[np.isfinite(self.length_mm)]


def shape_errors(surface: Surface, exact: Shape, partner: Sensor) -> PointErrors:
    """Return the errors of a surface."""
    valid = surface.reason == Reason.VALID
    visible = int(np.count_nonzero(exact.seen & exact.lit))
    found, true = (xyz[:, valid] for xyz in (surface.position, exact.xyz))
    return _errors(found, true, position_covariance(surface)[:, valid], partner, visible)


def displacement_errors(field: DisplacementField, truth: Truth, partner: Sensor) -> PointErrors:
    """Return the errors of the displacement between the reference state and another."""
    valid = field.reason == Reason.VALID
    visible = truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end
    start = truth.shape.xyz[:, valid]
    found, true = (start + moved[:, valid] for moved in (field.displacement, truth.displacement))
    covariance = covariance_in_space(field.covariance)[:, valid]
    return _errors(found, true, covariance, partner, int(np.count_nonzero(visible)))


def _errors(
    found: Floats, true: Floats, covariance: NDArray[np.floating], partner: Sensor, visible: int
) -> PointErrors:
    """Return the errors of points (3, n) with packed covariances (6, n)."""
    length = np.linalg.norm(found - true, axis=0)
    seen = [project(partner.intrinsics, partner.pose, np.ascontiguousarray(xyz.T)) for xyz in (found, true)]
    sigma = np.sqrt(trace(covariance))
    apart = np.linalg.norm(seen[0] - seen[1], axis=-1)
    return PointErrors(np.where(np.isfinite(length), length, np.inf), sigma, apart, visible)
