"""A camera or a projector that turns between two states is in the displacement's deviation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sms_jobs.bench.fringes.moved_sensors import Panel, panel_seen
from sms_jobs.kinds.calibration_factors import merged_sigma, states_from
from sms_jobs.metrology.calibration.point_factor import turns
from sms_jobs.virtual_rig.campaigns import small_plate


@cache
def seen() -> Panel:
    return panel_seen(4, 1, small_plate("plate"))


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("name", ["C1", "P1"])
def test_a_sensor_that_turns_is_in_the_displacement(name: str, stated: bool) -> None:
    """As much along the images of rays, which are tilted by 13 degrees, as across, where alone it is seen.

    What is stated is then the error, and noise; of noise alone it would be some 10 deviations.
    """
    z = seen().z(name, 0.060, 0.096, stated=stated)
    assert len(z) > 5_000
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.15)
    assert z.max() < 6.0


@pytest.mark.parametrize("stated", [True, False])
def test_sensors_that_stay_add_nothing(stated: bool) -> None:
    """Noise moves the misses of all rays together by less than a hundredth of a pixel."""
    z = seen().z("P1", 0.0, 0.0, stated=stated)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.15)


def test_what_turned_is_each_views_own(known_plate: Any) -> None:
    """Of two views that are merged, what the calibration says is common, and what has turned is not."""
    subject = known_plate.subject("S01", "C1P1")
    moved, surface = (
        known_plate.results[kind, own][name]
        for kind, own, name in (
            ("correlate", subject, "displacement"),
            ("reconstruct", known_plate.subject("S00", "C1P1"), "surface"),
        )
    )
    before, after = (
        known_plate.results["correlate", subject][f"factor_{key}"] for key in ("reference", "deformed")
    )
    half = np.full(surface.reason.shape, 0.5)
    valid = moved.reason == 0

    def merged(turned_px: float, views: int) -> Any:
        states = states_from(before, replace(after, turned_px=turned_px))
        return merged_sigma([(states, surface, moved)] * views, [2.0 / views * half] * views, valid)[:, valid]

    one, two = (merged(0.0, views).astype(np.float64) for views in (1, 2))
    np.testing.assert_allclose(two, one, rtol=2e-3)  # a part in a thousand is kept
    turned, of_two = (merged(1.0, views).astype(np.float64) for views in (1, 2))
    assert turned.min() > 20.0 * one.max()
    np.testing.assert_allclose(of_two**2 - one**2, 0.5 * (turned**2 - one**2), rtol=6e-3)
    assert states_from(before, after)[1].own == 0
    assert states_from(before, replace(after, turned_px=1.0))[1].own == turns(before.sensors).shape[1]
