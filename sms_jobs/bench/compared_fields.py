"""A quantity over an image, measured and exact, with what is stated of it, and its means over some pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.fields import DisplacementField
from sms_jobs.virtual_rig.truth import Truth


@dataclass(frozen=True)
class Mean:
    """The mean of a field over some pixels: measured, exact, and the standard deviation of what is measured.

    Values within a subset of each other are taken as one, since they share its pixels; NaN without pixels.
    """

    measured: float
    exact: float
    sigma: float

    @property
    def error(self) -> float:
        """Measured minus exact."""
        return self.measured - self.exact

    @property
    def z(self) -> float:
        """The error in units of the standard deviation."""
        return self.error / self.sigma


@dataclass(frozen=True)
class Compared:
    """A quantity in mm, (rows, columns); NaN where nothing is measured, or nothing is true.

    Attributes
    ----------
    measured, exact, sigma
        What is measured, what is true, and the standard deviation that is stated of what is measured.
    subset_px
        Side of the subsets.
    """

    measured: Floats
    exact: Floats
    sigma: Floats
    subset_px: int

    @property
    def error(self) -> Floats:
        """Measured minus exact."""
        return self.measured - self.exact

    def mean(self, where: Mask) -> Mean:
        """Return the mean over those of some pixels that are measured."""
        known = where & np.isfinite(self.measured) & np.isfinite(self.exact)
        if not known.any():
            return Mean(float("nan"), float("nan"), float("nan"))
        independent = max(np.count_nonzero(known) / self.subset_px**2, 1.0)
        stated = float(np.sqrt(np.mean(self.sigma[known] ** 2) / independent))
        return Mean(float(self.measured[known].mean()), float(self.exact[known].mean()), stated)


def reported_over_observed(normalised: Sequence[Floats]) -> float:
    """Return what errors are said to be over what they are, from errors in units of sigma."""
    return float(1.0 / np.sqrt(np.mean(np.concatenate([one.ravel() for one in normalised]) ** 2)))


def along(covariance: NDArray[np.floating], direction: Floats) -> Floats:
    """Return the variance along unit vectors (3, rows, columns), from packed covariances (6, ...)."""
    x, y, z = direction
    weights = np.stack([x * x, 2.0 * x * y, 2.0 * x * z, y * y, 2.0 * y * z, z * z])
    return np.asarray(np.einsum("krc,krc->rc", weights, covariance.astype(np.float64)))


def lengths(field: DisplacementField, truth: Truth) -> Compared:
    """Return the lengths of a displacement."""
    with np.errstate(invalid="ignore"):
        direction = field.displacement / np.linalg.norm(field.displacement, axis=0)
    return _compared(field, np.linalg.norm(truth.displacement, axis=0), direction)


def components(field: DisplacementField, truth: Truth, direction: Floats) -> Compared:
    """Return the components of a displacement along a unit vector (3,)."""
    everywhere = np.broadcast_to(direction[:, None, None], field.displacement.shape)
    return _compared(field, np.einsum("i,irc->rc", direction, truth.displacement), everywhere)


def _compared(field: DisplacementField, exact: Floats, direction: Floats) -> Compared:
    measured = np.einsum("irc,irc->rc", direction, field.displacement)
    variance = along(covariance_in_space(field.covariance), direction)
    return Compared(
        np.where(field.reason == 0, measured, np.nan),
        exact,
        np.sqrt(variance),
        2 * field.subset_radius_px + 1,
    )


def rms(values: Floats) -> float:
    """Return the root mean square of what is known; NaN of nothing."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
