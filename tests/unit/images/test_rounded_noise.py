"""Variances of whole grey levels: no multiple of anything, and not moved by what lies far outside."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.images.rounded_noise import variance_of_rounded


@pytest.mark.parametrize("sigma", [0.3, 0.5, 0.7, 1.0, 2.0, 3.0, 40.0])
@pytest.mark.parametrize("outliers", [0, 500])
def test_the_variance_of_whole_numbers_is_found(
    rng: np.random.Generator, sigma: float, outliers: int
) -> None:
    level = rng.uniform(0.0, 200.0, 20_000)
    shown = np.rint(level + rng.normal(0.0, sigma, (8, level.size)))
    # Sums of eight rounded numbers with changing sign, of which the levels drop out.
    values = shown[::2].sum(axis=0) - shown[1::2].sum(axis=0)
    values[:outliers] = rng.uniform(-4000.0, 4000.0, outliers)
    expected = 8.0 * (sigma**2 + 1.0 / 12.0)
    # A variance of 20,000 numbers is good to 1 %; four times that. Of 2.5 % of outliers over 8,000 levels
    # those within 3 of 113 levels' deviations are 0.2 % of all: they add up to 0.7 %.
    assert variance_of_rounded(values) == pytest.approx(expected, rel=0.05)


def test_values_that_are_nearly_all_alike_have_no_variance() -> None:
    assert variance_of_rounded(np.zeros(100)) == 0.0
