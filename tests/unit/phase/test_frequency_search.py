"""Any list of frequencies: heterodyne sets and numbers of fringes that are not whole."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.frequency_search import order_distance
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.metrology.phase.unwrapping_plan import can_climb

SETS = [
    (70, 64, 59),  # beats of 6 and 5, whose beat is 1
    (6, 10, 15),
    (1920 / 18, 1920 / 21.3, 1920 / 25.7),  # periods in pixels of a projector
]


@pytest.mark.parametrize("densities", SETS)
@pytest.mark.parametrize("noise", [10.0, 60.0])
def test_orders_are_found_and_what_is_not_sure_is_told(
    densities: tuple[float, ...], noise: float, rng: np.random.Generator
) -> None:
    assert not can_climb(densities)
    omega = rng.uniform(-pi, pi, (100, 200))
    phase = [omega * t + 2.0 * pi * k / 4 for t in densities for k in range(4)]
    level = 2000.0 + 1000.0 * np.cos(phase) + noise * rng.standard_normal((4 * len(densities), *omega.shape))
    frames = np.rint(level).astype(np.uint16)
    found = unwrap(frames, densities, 4, full_scale=4095, gain=0.0, read_noise=noise)
    trusted = ~found.ambiguous
    wrong = np.abs(found.omega - omega) > pi / max(densities)
    # As in the joint fit: 2 of 20,000 are expected at most.
    assert np.count_nonzero(wrong & trusted) < 9
    assert trusted.mean() > (0.99 if noise == 10.0 else 0.9)
    error = ((found.omega - omega) / found.omega_sigma)[trusted & ~wrong]
    assert np.std(error) == pytest.approx(1.0, abs=0.03)


def test_whole_numbers_that_are_written_with_a_point_are_the_same(rng: np.random.Generator) -> None:
    frames = rng.integers(0, 4000, (24, 8, 8), dtype=np.uint16)
    one, two = (
        unwrap(frames, densities, 4, full_scale=4095, gain=0.1, read_noise=2.0)
        for densities in ((32, 31, 30, 28, 24, 16), (32.0, 31.0, 30.0, 28.0, 24.0, 16.0))
    )
    np.testing.assert_array_equal(one.omega, two.omega)


def test_the_distance_is_that_of_the_nearest_orders() -> None:
    # One fringe of 5 on, the phase of 7 is 2/5 of a turn on, less what another omega explains.
    apart = np.array([[0.0, 2.0 * pi * m * 5 / 7 - 2.0 * pi * round(m * 5 / 7)] for m in range(1, 7)])
    t = np.array([7.0, 5.0])
    left = np.sum(apart**2, axis=1) - (apart @ t) ** 2 / (t @ t)
    assert order_distance((7, 5)) == pytest.approx(np.sqrt(left.min()))


@pytest.mark.parametrize("densities", [(16, 32), (12.5, 25.0), (1920 / 18, 1920 / 21, 1920 / 24)])
def test_places_that_look_alike_are_refused(densities: tuple[float, ...]) -> None:
    frames = np.zeros((4 * len(densities), 2, 2), np.uint16)
    with pytest.raises(InvalidInput, match="leave two places of the projector whose phases differ by"):
        unwrap(frames, densities, 4, full_scale=4095, gain=0.0, read_noise=1.0)
