"""The tilt limit, against a tripod and a bar made of points."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, radians, sin, tan

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.devices.clearance import distance_to_tripod, tilt_range
from sms_jobs.metrology.calibration.stage.pan_tilt import stage_rotation
from sms_jobs.records.instruments import TripodClearance

BENCH = TripodClearance(
    bar_length_mm=400.0,
    sphere_radius_mm=19.0,
    stalk_mm=60.0,
    slide_mm=15.0,
    top_below_axes_mm=120.0,
    top_radius_mm=50.0,
    leg_angle_rad=radians(25.0),
    clearance_mm=10.0,
)


def cone_points(clearance: TripodClearance) -> NDArray[np.float64]:
    """Return points of the cone's surface, 4 mm apart and dense in angle: x'' is up."""
    depths = np.arange(0.0, 500.0, 4.0)
    radii = clearance.top_radius_mm + depths * tan(clearance.leg_angle_rad)
    angles = np.arange(0.0, 2.0 * pi, radians(1.0))
    side = [
        (-clearance.top_below_axes_mm - d, r * cos(a), r * sin(a))
        for d, r in zip(depths, radii, strict=True)
        for a in angles
    ]
    top = [
        (-clearance.top_below_axes_mm, r * cos(a), r * sin(a))
        for r in np.arange(0.0, clearance.top_radius_mm, 4.0)
        for a in angles
    ]
    return np.array(side + top)


@pytest.mark.parametrize("tilt_deg", [-60.0, -20.0, 0.0, 35.0, 50.0])
def test_the_distance_is_that_of_points_at_any_pan(tilt_deg: float) -> None:
    tilt = radians(tilt_deg)
    gap = distance_to_tripod(BENCH, tilt)
    assert gap > 0.0
    cone = cone_points(BENCH)
    half = 0.5 * BENCH.bar_length_mm
    for pan in (0.0, 0.7, 2.0):
        rotation = stage_rotation(pan, tilt)
        nearest = np.inf
        for z in np.linspace(-half, half, 41):
            point = rotation @ (BENCH.stalk_mm, 0.0, BENCH.slide_mm + z)
            thickness = BENCH.sphere_radius_mm if abs(abs(z) - half) < 1e-9 else 0.0
            nearest = min(nearest, float(np.linalg.norm(cone - point, axis=1).min()) - thickness)
        # Between points 4 mm apart along the cone and 10 mm along the bar the distance is missed by less than
        # 10^2 / (8 x 50) = 0.25 mm, and by 3 mm between points 1 degree apart at the far end of the cone.
        assert gap == pytest.approx(nearest, abs=1.0)


def test_within_the_range_nothing_touches_and_at_its_ends_the_clearance_is_kept() -> None:
    low, high = tilt_range(BENCH, radians(-108.0), radians(108.0))
    assert radians(-108.0) < low < 0.0 < high < radians(108.0)
    for tilt in np.linspace(low, high, 101):
        assert distance_to_tripod(BENCH, tilt) >= BENCH.clearance_mm
    # Bisection of half a degree in 30 steps leaves 1e-11 rad, times the bar's 215 mm.
    assert distance_to_tripod(BENCH, low) == pytest.approx(BENCH.clearance_mm, abs=1e-6)
    assert distance_to_tripod(BENCH, high) == pytest.approx(BENCH.clearance_mm, abs=1e-6)


def test_the_limit_follows_from_geometry() -> None:
    low, high = tilt_range(BENCH, radians(-108.0), radians(108.0))
    # A longer bar, a higher tripod, wider legs and more clearance leave less.
    for changed in (
        replace(BENCH, bar_length_mm=500.0),
        replace(BENCH, top_below_axes_mm=100.0),
        replace(BENCH, leg_angle_rad=radians(35.0)),
        replace(BENCH, clearance_mm=30.0),
    ):
        narrow = tilt_range(changed, radians(-108.0), radians(108.0))
        assert narrow[1] - narrow[0] < high - low
    # A bar in the middle of its clamp is limited alike on both sides.
    even = tilt_range(replace(BENCH, slide_mm=0.0), radians(-108.0), radians(108.0))
    assert even[0] == pytest.approx(-even[1], abs=1e-9)


def test_a_short_bar_is_limited_by_the_axis_alone() -> None:
    short = replace(BENCH, bar_length_mm=80.0, slide_mm=0.0)
    assert tilt_range(short, -1.0, 1.2) == (-1.0, 1.2)


def test_a_bar_that_touches_at_home_is_refused() -> None:
    with pytest.raises(InvalidInput, match=r"mm from the tripod at tilt 0, less than the clearance of 10 mm"):
        tilt_range(replace(BENCH, stalk_mm=-115.0), -1.0, 1.0)
