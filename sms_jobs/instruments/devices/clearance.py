"""How far a stage may tilt before a ball bar meets the tripod (thesis 3.2.3, Figure 18)."""

from __future__ import annotations

from math import cos, hypot, radians, sin

from sms_jobs.errors import InvalidInput
from sms_jobs.records.instruments import TripodClearance

_STEP_RAD = radians(0.5)
_BISECTIONS = 30
_POINTS = 65  # along the bar


def distance_to_tripod(clearance: TripodClearance, tilt_rad: float) -> float:
    """Return the distance in mm between bar or spheres and the tripod's cone; negative inside it.

    The frame is the tripod's: x'' up along the pan axis, the origin where the axes meet. At a tilt phi a
    point (s, 0, z) of the bar is s cos phi + z sin phi high and |z cos phi - s sin phi| from the pan axis,
    whatever the pan.
    """
    half = 0.5 * clearance.bar_length_mm
    gaps = []
    for k in range(_POINTS):
        z = clearance.slide_mm - half + clearance.bar_length_mm * k / (_POINTS - 1)
        height = clearance.stalk_mm * cos(tilt_rad) + z * sin(tilt_rad)
        radius = abs(z * cos(tilt_rad) - clearance.stalk_mm * sin(tilt_rad))
        thickness = clearance.sphere_radius_mm if k in (0, _POINTS - 1) else 0.0
        gaps.append(_distance_to_cone(clearance, radius, height) - thickness)
    return min(gaps)


def tilt_range(clearance: TripodClearance, minimum_rad: float, maximum_rad: float) -> tuple[float, float]:
    """Return the largest range of tilts about 0, within the given one, that keeps the clearance; in rad.

    Raises
    ------
    InvalidInput
        The bar is too near the tripod already at 0.
    """
    gap = distance_to_tripod(clearance, 0.0)
    if gap < clearance.clearance_mm:
        raise InvalidInput(
            f"the bar is {gap:.1f} mm from the tripod at tilt 0, less than the clearance of "
            f"{clearance.clearance_mm:g} mm: mount it higher, or correct the geometry in the rig file"
        )
    return _reach(clearance, minimum_rad), _reach(clearance, maximum_rad)


def _reach(clearance: TripodClearance, limit_rad: float) -> float:
    steps = max(1, round(abs(limit_rad) / _STEP_RAD))
    free = 0.0
    for k in range(1, steps + 1):
        tilt = limit_rad * k / steps
        if distance_to_tripod(clearance, tilt) >= clearance.clearance_mm:
            free = tilt
            continue
        blocked = tilt
        for _ in range(_BISECTIONS):
            middle = 0.5 * (free + blocked)
            if distance_to_tripod(clearance, middle) >= clearance.clearance_mm:
                free = middle
            else:
                blocked = middle
        return free
    return limit_rad


def _distance_to_cone(clearance: TripodClearance, radius: float, height: float) -> float:
    """Return the signed distance of a point to the cone that is cut off at the tripod's top."""
    out, up = radius - clearance.top_radius_mm, height + clearance.top_below_axes_mm
    angle = clearance.leg_angle_rad
    along, away = out * sin(angle) - up * cos(angle), out * cos(angle) + up * sin(angle)
    if out <= 0.0 and along <= 0.0:
        return up if up >= 0.0 else max(up, away)
    if along >= 0.0:
        return away if away >= 0.0 else max(up, away)
    return hypot(out, up)
