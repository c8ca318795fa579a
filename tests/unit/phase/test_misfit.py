"""What a pixel's returns leave beyond noise is in their deviations, and noise itself is not."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.metrology.images.masks import phase_error_factor
from sms_jobs.metrology.phase.ranging.misfit import misfit_factor

FREEDOM = 125


def test_noise_alone_makes_no_deviation_larger(rng: np.random.Generator) -> None:
    noise = np.full((100, 100), 20.0, np.float32)
    residual = (noise * np.sqrt(rng.chisquare(FREEDOM, noise.shape) / FREEDOM)).astype(np.float32)
    found = misfit_factor(residual, noise, phase_error_factor(FREEDOM, 0.999))
    # One pixel in a thousand is beyond the limit: ten of these, and 26 is five deviations more.
    assert np.count_nonzero(found > 1.0) < 26
    assert found.max() < 1.2


def test_misfit_beyond_noise_counts_as_noise() -> None:
    residual = np.array([[0.5, 1.2, 2.0, 5.0, np.nan]], np.float32)
    found = misfit_factor(residual, np.ones_like(residual), 1.2)
    # sqrt(1 + 4 - 1.44) and sqrt(1 + 25 - 1.44); single precision.
    assert found[0, :4] == pytest.approx([1.0, 1.0, np.sqrt(3.56), np.sqrt(24.56)], rel=1e-6)
    assert np.isnan(found[0, 4])
