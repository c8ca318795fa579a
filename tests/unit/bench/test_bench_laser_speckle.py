"""Laser speckle is matched as exactly as other speckle, and the study says how exactly."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.bench.correlated.half_and_half import match_halves
from sms_jobs.bench.correlated.speckle_pairs import Pattern, translated
from sms_jobs.bench.studies.laser_speckle import translation


def test_what_a_translated_pattern_shows_has_moved() -> None:
    patterns: tuple[Pattern, ...] = ("laser", "blobs", "dots")
    for pattern in patterns:
        still, moved = translated(pattern, 96, 5.0, -3.0, 7)
        assert still.std() == pytest.approx(400.0)
        # Away from the rim, where blobs come in and waves come round.
        np.testing.assert_allclose(moved[20:70, 20:70], still[23:73, 15:65], atol=1e-3)


def test_laser_speckle_is_matched_exactly_and_sigma_holds() -> None:
    exact, noisy = (translation("laser", noise, "gauss-newton", seeds=1) for noise in (0.0, 0.025))
    assert exact.matched() == noisy.matched() == 1.0
    # What the quintic spline leaves: half the sampling rate is four times the highest frequency.
    assert exact.rms() < 1e-4
    # The range that the bench asks of stated deviations.
    assert 0.8 < noisy.stated() / noisy.rms() < 1.2
    assert noisy.bias() < 0.2 * noisy.stated()


def test_regions_part_halves_of_laser_speckle() -> None:
    shifts = ((0.4, 0.8), (1.2, 2.4))
    parted, plain = (match_halves(parted=p, radius=10, shifts=shifts, pattern="laser") for p in (True, False))
    near = np.abs(parted.distance) < 10
    # Without noise the required 0.01 px, and a fraction of the halves' 0.4 to 1.2 px.
    assert parted.rms()[near].max() < 0.01
    assert plain.rms()[near].max() > 0.1
    assert parted.folded().sigma.shape == (2, len(parted.distance) // 2, 2 * parted.sigma.shape[2])
