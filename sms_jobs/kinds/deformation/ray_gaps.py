"""How far the rays of a later state miss each other, beside those of the state at rest."""

from __future__ import annotations

import numpy as np

from sms_jobs.kinds.surface_ports import position_covariance
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.records.fields import Surface
from sms_jobs.records.reasons import Reason

_TURNED_PX = 0.05
"""From what change of the misses on somebody is told: less is in the deviations, and no reason to stop."""
_GROWN = 5.0
"""How much farther they have to miss each other, in deviations of their points, to be told."""


def told_of_gaps(at_rest: Surface, later: Surface, turned_px: float = 0.0, *, counted: bool = False) -> str:
    """Return what it means that rays which met at rest miss each other now; empty where they do not.

    A calibration that is wrong for both states makes gaps in both, and its errors nearly cancel in the
    displacement. What has come since does not, and shows in no noise. `counted` says that the calibration's
    part of the displacement's deviation is larger for it, `turned_px` by how much (`moved_since`).
    """
    before, now = _gap(at_rest), _gap(later)
    if before is None or now is None:
        return ""
    (gap_before, sigma_before), (gap, sigma) = before, now
    if turned_px > _TURNED_PX:
        missed = f"{turned_px:.2g} px more than"
    elif gap > max(sigma, _GROWN * gap_before * sigma / sigma_before):
        missed = f"{gap:.2g} mm and did by {gap_before:.2g} mm"
    else:
        return ""
    told = (
        "the calibration's part of the displacement's deviation is larger for it"
        if counted
        else "the displacement is off by more than its deviation says"
    )
    return (
        f"the rays miss each other by {missed} at rest: a sensor has moved since, or its images are of "
        f"another moment, and {told}; see that the images belong together, or calibrate again"
    )


def _gap(surface: Surface) -> tuple[float, float] | None:
    """Return the rms gap of the rays, and the median deviation of a point, in mm; None where unknown."""
    valid = surface.reason == Reason.VALID
    if surface.ray_gap is None or surface.covariance is None or not valid.any():
        return None
    gap = surface.ray_gap[valid].astype(np.float64)
    variance = trace(position_covariance(surface))[valid]
    return float(np.sqrt(np.mean(gap**2))), float(np.sqrt(np.median(variance)))
