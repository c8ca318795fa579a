"""Any list of fringe densities is either unwrapped right or refused."""

from __future__ import annotations

from math import gcd, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.phase.temporal_unwrapping import unwrap
from sms_jobs.metrology.phase.unwrapping_plan import unwrapping_plan

lists = st.lists(st.integers(1, 64), min_size=1, max_size=8).map(tuple)


@given(lists, st.integers(3, 6), st.integers(0, 2**32 - 1))
def test_any_list_is_unwrapped_right_or_refused(densities: tuple[int, ...], steps: int, seed: int) -> None:
    try:
        plan = unwrapping_plan(densities)
    except InvalidInput:
        assert all(abs(a - b) != 1 for a in densities for b in densities)
        assert 1 not in densities
        return
    assert gcd(*densities) == 1
    omega = np.random.default_rng(seed).uniform(-pi + 0.01, pi - 0.01, size=(2, 16))
    frames = np.array(
        [
            np.rint(32_000.0 + 30_000.0 * np.cos(omega * t + 2.0 * pi * k / steps))
            for t in densities
            for k in range(steps)
        ]
    ).astype(np.uint16)
    found = unwrap(frames, densities, steps, full_scale=65_535, gain=0.0, read_noise=0.3)
    # Rounding is a phase error of at most 2 x 0.5 / 30000 rad a density; a rung multiplies it by at most
    # the amplification (below 600), which stays far from half a fringe.
    assert plan.amplification < 600.0
    np.testing.assert_allclose(found.omega, omega, atol=4e-5)
    assert not found.ambiguous.any()


@given(lists)
def test_reordering_a_list_does_not_make_it_harder(densities: tuple[int, ...]) -> None:
    try:
        plan = unwrapping_plan(densities)
    except InvalidInput:
        return
    assert unwrapping_plan(densities[::-1]).amplification == pytest.approx(plan.amplification)


@given(lists)
def test_every_rung_stands_on_one_below_and_is_what_it_says(densities: tuple[int, ...]) -> None:
    try:
        plan = unwrapping_plan(densities)
    except InvalidInput:
        return
    t = np.array(densities)
    rungs = plan.factors[:, 0] * t[plan.first] + plan.factors[:, 1] * t[plan.second]
    np.testing.assert_array_equal(rungs, plan.density)
    assert (plan.below < np.arange(plan.below.size)).all()
    assert (plan.density[plan.below < 0] == 1.0).all()
    np.testing.assert_array_equal(plan.density[plan.top], t)
