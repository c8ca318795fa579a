"""How far the views of one camera differ, beside what they state: what no view can know alone."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.joining.merging import CONTRADICTION
from sms_jobs.metrology.geometry.planes import in_space, trace
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.reasons import Reason


def told_of_views(views: Sequence[str], moved: Sequence[DisplacementField]) -> str:
    """Return which views of a camera contradict each other; empty where none do.

    A sensor that turns along the images of its own rays leaves no gap between them. Only another view shows
    it, and the mean of both is wrong.
    """
    pairs = combinations(zip(views, moved, strict=True), 2)
    return "; ".join(filter(None, (_told(*one, *other) for one, other in pairs)))


def _told(first: str, one: DisplacementField, second: str, other: DisplacementField) -> str:
    both = (one.reason == Reason.VALID) & (other.reason == Reason.VALID)
    if not both.any():
        return ""
    apart = np.linalg.norm(
        in_space(one.displacement)[:, both] - in_space(other.displacement)[:, both], axis=0
    )
    stated = np.sqrt(_variance(one, both) + _variance(other, both))
    if np.median(apart / stated) <= CONTRADICTION:
        return ""
    return (
        f"the displacements of {first} and {second} differ by {np.median(apart):.2g} {one.unit} (median) "
        f"where {np.median(stated):.2g} {one.unit} is stated: a sensor has moved, or its images are of "
        "another moment; the merged displacement lies between them, as its deviation says; see what each "
        "view says by itself, and calibrate again"
    )


def _variance(moved: DisplacementField, pixels: Mask) -> Floats:
    """Return the variance of a displacement's length (n,) at some pixels, with the calibration's part."""
    noise = trace(moved.covariance)[pixels]
    return np.asarray(noise + calibrations_variance(moved)[pixels])


def calibrations_variance(moved: DisplacementField) -> Floats:
    """Return the calibration's part of the variance (rows, columns) of a displacement; 0 where unknown."""
    if moved.sigma_calibration is None:
        return np.zeros(moved.reason.shape)
    return np.asarray(np.nansum(np.square(moved.sigma_calibration, dtype=np.float64), axis=0))
